"""Prints of packages: blocks of colour, a brand in large letters, pictures, small print, tables, bar codes.

The faces of one package share a brand: its colours, its name and its letters.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

Image = UInt8[np.ndarray, "h w 3"]
Colour = tuple[int, int, int]

_LETTERS = np.array(list("AAABCDEEEFGHIIKLMNOOPRSTUVWXYZ"))
_SMALL = np.array(list("aaabcdeeefghiiklmnooprstuuvwz   1250%"))


@dataclass(frozen=True)
class Brand:
    """Colours (R, G, B), name and OpenCV font of a product."""

    ground: Colour
    accent: Colour
    ink: Colour
    name: str
    font: int


def random_brand(rng: np.random.Generator) -> Brand:
    """Sample a brand: mostly saturated colours, some white and dark packages."""
    hue = rng.random()
    draw = rng.random()
    if draw < 0.55:
        ground = colorsys.hsv_to_rgb(hue, rng.uniform(0.55, 1.0), rng.uniform(0.35, 0.95))
    elif draw < 0.85:
        ground = colorsys.hsv_to_rgb(hue, rng.uniform(0.0, 0.2), rng.uniform(0.75, 1.0))
    else:
        ground = colorsys.hsv_to_rgb(hue, rng.uniform(0.1, 0.9), rng.uniform(0.05, 0.25))
    accent = colorsys.hsv_to_rgb(
        (hue + rng.normal(0.3, 0.25)) % 1, rng.uniform(0.4, 1.0), rng.uniform(0.3, 1.0)
    )
    dark = sum(ground) < 1.5
    ink = (0.97, 0.96, 0.93) if dark else (0.08, 0.08, 0.12)
    if rng.random() < 0.3:
        ink = accent
    name = "".join(rng.choice(_LETTERS, rng.integers(3, 9)))
    if rng.random() < 0.4:
        name = name.capitalize()
    return Brand(_bytes(ground), _bytes(accent), _bytes(ink), name, int(rng.integers(0, 8)))


def front(brand: Brand, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return the main face, upright: blocks, a picture, the name, lines of text."""
    rows = size[0]
    image = _ground(brand, size, rng)
    if rng.random() < 0.85:
        _picture(image, brand, rng)
    _name(image, brand, rng, int(rows * rng.uniform(0.12, 0.35)))
    for _ in range(rng.integers(0, 4)):
        _badge(image, brand, rng)
    if rng.random() < 0.5:
        _name(image, brand, rng, int(rows * rng.uniform(0.6, 0.95)), 0.4)
    return image


def side(brand: Brand, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return a narrow face, upright: small print, a table of ingredients, a bar code, often the name."""
    rows, columns = size
    image = np.full(
        (rows, columns, 3), brand.ground if rng.random() < 0.6 else (238, 236, 228), dtype=np.uint8
    )
    ink = brand.ink if tuple(image[0, 0]) == brand.ground else (25, 25, 30)
    if rng.random() < 0.7:
        _name(image, brand, rng, int(rows * rng.uniform(0.12, 0.25)))
    top = int(rows * rng.uniform(0.28, 0.4))
    if rng.random() < 0.5:
        _table(image, (int(0.12 * columns), top, int(0.88 * columns), int(rows * 0.7)), rng)
    else:
        _small_print(image, ink, top, int(rows * 0.7), rng)
    if rng.random() < 0.7:
        _bar_code(image, int(rng.uniform(0.1, 0.4) * columns), int(0.76 * rows), rng)
    return image


def top(brand: Brand, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return the lid: plain, a stripe, or the name."""
    image = np.full((*size, 3), brand.ground, dtype=np.uint8)
    if rng.random() < 0.5:
        at, wide = sorted(rng.integers(0, size[0], 2))
        image[at:wide] = brand.accent
    if rng.random() < 0.5:
        _name(image, brand, rng, int(0.6 * size[0]))
    return image


def wrapped(size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return a print that goes once around a can, bottle or tube, first row at the bottom."""
    brand = random_brand(rng)
    rows, columns = size
    fronts = int(rng.integers(1, 4))
    width = columns // (2 * fronts)
    image = np.full((rows, columns, 3), brand.ground, dtype=np.uint8)
    for index in range(fronts):
        at = 2 * index * width
        image[:, at : at + width] = front(brand, (rows, width), rng)
        image[:, at + width : at + 2 * width] = side(brand, (rows, width), rng)
    return image[::-1].copy()


def _bytes(color: tuple[float, float, float]) -> Colour:
    red, green, blue = (round(255 * c) for c in color)
    return red, green, blue


def _ground(brand: Brand, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Return the ground with a gradient or one to three blocks of colour."""
    rows, columns = size
    image = np.full((rows, columns, 3), brand.ground, dtype=np.uint8)
    kind = rng.integers(4)
    if kind == 0:
        share = np.linspace(0, 1, rows)[:, None, None] ** rng.uniform(0.5, 3)
        image[:] = share * np.array(brand.accent) + (1 - share) * np.array(brand.ground)
    elif kind == 1:
        at = int(rng.uniform(0.3, 0.8) * rows)
        cv2.ellipse(
            image,
            (columns // 2, rows + at // 3),
            (columns, rows - at + at // 3),
            0,
            180,
            360,
            brand.accent,
            -1,
        )
    else:
        for _ in range(rng.integers(1, 4)):
            x, y = rng.integers(-columns // 4, columns), rng.integers(-rows // 4, rows)
            corner = (
                int(x + rng.integers(columns // 5, columns)),
                int(y + rng.integers(rows // 8, rows // 2)),
            )
            color = brand.accent if rng.random() < 0.7 else (240, 240, 235)
            cv2.rectangle(image, (int(x), int(y)), corner, color, -1)
    return image


def _picture(image: Image, brand: Brand, rng: np.random.Generator) -> None:
    """Draw a picture: a cluster of shaded blobs, as of food, on a plate or a patch of light."""
    rows, columns = image.shape[:2]
    middle = np.array([rng.uniform(0.3, 0.7) * columns, rng.uniform(0.45, 0.8) * rows])
    reach = rng.uniform(0.15, 0.4) * min(rows, 1.5 * columns)
    if rng.random() < 0.5:
        plate = (245, 243, 238) if rng.random() < 0.6 else brand.accent
        cv2.ellipse(image, _at(middle), _at((1.2 * reach, 0.8 * reach)), 0, 0, 360, plate, -1)
    hue = rng.random() if rng.random() < 0.4 else rng.uniform(0.02, 0.16)  # food is brown, red or yellow
    for _ in range(rng.integers(4, 24)):
        centre = middle + rng.normal(0, 0.4, 2) * reach * (1, 0.7)
        axes = rng.uniform(0.1, 0.45, 2) * reach + 1
        color = _bytes(
            colorsys.hsv_to_rgb((hue + rng.normal(0, 0.05)) % 1, rng.uniform(0.3, 0.95), rng.uniform(0.35, 1))
        )
        turn = float(rng.uniform(0, 180))
        dark = (color[0] // 2, color[1] // 2, color[2] // 2)
        cv2.ellipse(image, _at(centre + 1), _at(axes), turn, 0, 360, dark, -1)
        cv2.ellipse(image, _at(centre), _at(axes), turn, 0, 360, color, -1)
        light = (min(color[0] + 60, 255), min(color[1] + 60, 255), min(color[2] + 60, 255))
        cv2.ellipse(image, _at(centre - 0.3 * axes.min()), _at(0.35 * axes), turn, 0, 360, light, -1)


def _name(image: Image, brand: Brand, rng: np.random.Generator, baseline: int, share: float = 1.0) -> None:
    """Write the name as large as the width allows, with an outline or on a patch."""
    columns = image.shape[1]
    wide = share * rng.uniform(0.6, 1.05) * columns
    (width, height), _ = cv2.getTextSize(brand.name, brand.font, 1.0, 2)
    scale = wide / max(width, 1)
    scale = min(scale, 0.35 * image.shape[0] / max(height, 1))
    at = (int((columns - scale * width) / 2), int(max(baseline, scale * height + 2)))
    thick = max(1, int(rng.integers(1, 4) * scale))
    if rng.random() < 0.4:
        cv2.rectangle(
            image,
            (0, at[1] - int(1.3 * scale * height)),
            (columns, at[1] + int(0.3 * scale * height)),
            brand.accent,
            -1,
        )
    if rng.random() < 0.4:
        cv2.putText(image, brand.name, at, brand.font, scale, (250, 250, 250), thick + 2, cv2.LINE_AA)
    cv2.putText(image, brand.name, at, brand.font, scale, brand.ink, thick, cv2.LINE_AA)


def _badge(image: Image, brand: Brand, rng: np.random.Generator) -> None:
    rows, columns = image.shape[:2]
    centre = _at(rng.uniform(0.1, 0.9, 2) * (columns, rows))
    color = _bytes(colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.5, 1), rng.uniform(0.5, 1)))
    radius = int(rng.uniform(0.05, 0.14) * columns) + 1
    cv2.circle(image, centre, radius, color, -1)
    cv2.circle(image, centre, max(radius - 2, 1), brand.ink, 1)


def _small_print(image: Image, ink: Colour, first: int, last: int, rng: np.random.Generator) -> None:
    columns = image.shape[1]
    for row in range(first, last, int(rng.integers(5, 9))):
        text = "".join(rng.choice(_SMALL, columns // 5))
        cv2.putText(image, text, (int(0.08 * columns), row), 0, 0.22, ink, 1)
        image[:, int(0.92 * columns) :] = image[0, 0]


def _table(image: Image, corners: tuple[int, int, int, int], rng: np.random.Generator) -> None:
    left, first, right, last = corners
    cv2.rectangle(image, (left, first), (right, last), (245, 245, 245), -1)
    cv2.rectangle(image, (left, first), (right, last), (20, 20, 20), 1)
    for row in range(first + 6, last, 6):
        cv2.line(image, (left, row), (right, row), (90, 90, 90), 1)
        length = int(rng.uniform(0.2, 0.6) * (right - left))
        cv2.line(image, (left + 3, row - 3), (left + 3 + length, row - 3), (40, 40, 40), 1)
        cv2.line(image, (right - 9, row - 3), (right - 3, row - 3), (40, 40, 40), 1)


def _bar_code(image: Image, left: int, first: int, rng: np.random.Generator) -> None:
    rows, columns = image.shape[:2]
    last, right = min(first + rows // 7, rows), min(left + int(0.45 * columns), columns)
    image[first:last, left:right] = 250
    for x in range(left + 2, right - 2):
        if rng.random() < 0.5:
            image[first + 2 : last - 3, x] = 15


def _at(point: np.ndarray | tuple[float, float]) -> tuple[int, int]:
    return int(point[0]), int(point[1])
