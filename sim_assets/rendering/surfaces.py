"""Surfaces of things by name: wood, fabric, marble, leaves, steel, skin, prints; atlases of them."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sim_assets.rendering.colors import any_color
from sim_assets.rendering.packaging import Brand, front, random_brand, side, top
from sim_assets.rendering.texture_coordinates import ATLAS, CELLS

Image = UInt8[np.ndarray, "h w 3"]
Size = tuple[int, int]
Painter = Callable[[np.random.Generator, Size], Image]

ATLAS_SIZE = (256, 384)  # rows, columns of the texture of a distractor
PRINTED = (front, side, top)


def atlas(surfaces: Sequence[str], rng: np.random.Generator, wild: float = 0.0) -> Image:
    """Paint the cells of an atlas, first row at the bottom.

    Args:
        surfaces: names of the cells' surfaces, keys of PAINTERS or "print"; three prints in a row are the
            front, the side and the top of one package. Unknown names and missing cells get any surface.
        rng: random generator.
        wild: probability of an arbitrary surface for a cell (training of detectors).
    """
    size = (ATLAS_SIZE[0] // ATLAS[0], ATLAS_SIZE[1] // ATLAS[1])
    image = np.zeros((*ATLAS_SIZE, 3), dtype=np.uint8)
    prints, brand = 0, random_brand(rng)
    for cell in range(min(len(surfaces), CELLS)):
        name = surfaces[cell]
        if name == "print" and rng.random() >= wild:
            if prints % 3 == 0:
                brand = random_brand(rng)
            face = _printed(brand, prints % 3, size, rng)
        else:
            face = surface("any" if rng.random() < wild else name, rng, size)
        prints += name == "print"
        row, column = divmod(cell, ATLAS[1])
        image[row * size[0] : (row + 1) * size[0], column * size[1] : (column + 1) * size[1]] = face[::-1]
    return image


def surface(name: str, rng: np.random.Generator, size: Size) -> Image:
    """Return a texture of a surface, upright (first row at the top)."""
    if name not in PAINTERS:
        name = _ANY[rng.integers(len(_ANY))]
    return PAINTERS[name](rng, size)


def _printed(brand: Brand, index: int, size: Size, rng: np.random.Generator) -> Image:
    return PRINTED[index](brand, size, rng)


def noise(rng: np.random.Generator, size: Size, across: float, along: float) -> Float[np.ndarray, "h w"]:
    """Return smooth noise of unit variance with standard deviations of its kernel along columns and rows."""
    coarse = (max(size[0] // max(int(along / 2), 1), 4), max(size[1] // max(int(across / 2), 1), 4))
    field = rng.standard_normal(coarse, dtype=np.float32)
    field = cv2.GaussianBlur(field, (0, 0), min(across, 2.0) + 0.01, sigmaY=min(along, 2.0) + 0.01)
    field = cv2.resize(field, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    return field / max(float(field.std()), 1e-6)


def tinted(color: tuple[float, float, float], tone: np.ndarray) -> Image:
    """Return a colour times a field of tones (h, w) about 1."""
    return (255 * np.clip(np.array(color) * tone[..., None], 0, 1)).astype(np.uint8)


def blended(first: Sequence[float], second: Sequence[float], share: np.ndarray) -> Image:
    """Return a mixture of two colours by the (h, w) share of the second, clipped to 0..1."""
    share = np.clip(share, 0, 1)[..., None]
    return (255 * np.clip((1 - share) * np.array(first) + share * np.array(second), 0, 1)).astype(np.uint8)


def hsv(rng: np.random.Generator, hue: tuple[float, float], saturation: tuple[float, float],
        value: tuple[float, float]) -> tuple[float, float, float]:  # fmt: skip
    """Sample a colour between bounds of hue, saturation and value."""
    return colorsys.hsv_to_rgb(rng.uniform(*hue) % 1, rng.uniform(*saturation), rng.uniform(*value))


def wood_color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Sample a colour from pale birch to dark walnut, or of reddish stains."""
    return hsv(rng, (0.045, 0.11), (0.25, 0.65), (0.25, 0.9))


def veneer(rng: np.random.Generator, size: Size) -> Image:
    """Paint wood with grain along the rows and slow waves, without joints."""
    grain = noise(rng, size, 60, 1.0) * rng.uniform(0.02, 0.09)
    figure = np.sin(noise(rng, size, 40, 8) * rng.uniform(0.5, 3) + np.linspace(0, 12, size[0])[:, None])
    return tinted(
        wood_color(rng), 1 + grain + rng.uniform(0, 0.08) * figure + 0.03 * noise(rng, size, 80, 12)
    )


def fabric(rng: np.random.Generator, size: Size) -> Image:
    """Paint cloth: plain weave, stripes, checks or a print of flowers."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    first, second = any_color(rng), any_color(rng)
    pitch, kind = rng.uniform(8, 40), rng.integers(5)
    across, along = (columns % pitch) < pitch / 2, (rows % pitch) < pitch / 2
    if kind == 0:
        share = across * 0.5 + along * 0.5  # gingham
    elif kind == 1:
        share = 1.0 * across
    elif kind == 2:
        share = 1.0 * (noise(rng, size, pitch / 3, pitch / 3) > 0.8)
    else:
        share = 0.0 * across
    weave = 1 + 0.04 * np.sin(rows * 1.6) + 0.04 * np.sin(columns * 1.6) + 0.04 * noise(rng, size, 1, 1)
    image = blended(first, second, share) * weave[..., None] + 6 * noise(rng, size, 20, 20)[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def marble(rng: np.random.Generator, size: Size) -> Image:
    """Paint veined or speckled stone."""
    light = rng.random() < 0.7
    base = hsv(rng, (0.05, 0.15), (0, 0.15), (0.7, 1.0) if light else (0.05, 0.4))
    vein = hsv(rng, (0.0, 1.0), (0, 0.3), (0.2, 0.6) if light else (0.4, 0.9))
    if rng.random() < 0.5:
        veins = np.exp(-np.abs(noise(rng, size, 18, 18) + 0.3 * noise(rng, size, 4, 4)) * rng.uniform(4, 12))
        return blended(base, vein, rng.uniform(0.3, 0.9) * veins)
    return blended(base, vein, 0.5 * (noise(rng, size, 1.2, 1.2) > 0.9) + 0.15 * noise(rng, size, 10, 10))


def leaf(rng: np.random.Generator, size: Size) -> Image:
    """Paint leaves: green with lighter ribs."""
    base = hsv(rng, (0.2, 0.38), (0.35, 0.9), (0.15, 0.6))
    rows, columns = np.mgrid[: size[0], : size[1]]
    ribs = (np.abs(columns - size[1] / 2) + rows) % 18 < 2
    return tinted(base, 1 + 0.25 * ribs + 0.12 * noise(rng, size, 8, 8))


def steel(rng: np.random.Generator, size: Size) -> Image:
    """Paint brushed or cast metal, with reflections as soft bands."""
    base = hsv(rng, (0.05, 0.65), (0, 0.12), (0.3, 0.85))
    if rng.random() < 0.1:
        base = hsv(rng, (0.05, 0.14), (0.4, 0.7), (0.5, 0.9))  # brass, copper
    return tinted(base, 1 + 0.05 * noise(rng, size, 60, 0.8) + 0.15 * noise(rng, size, 40, 14))


def plain(
    rng: np.random.Generator, size: Size, color: tuple[float, float, float], rough: float = 0.02
) -> Image:
    """Paint one colour with faint noise and uneven light."""
    return tinted(color, 1 + rough * noise(rng, size, 2, 2) + 0.03 * noise(rng, size, 30, 30))


def cover(rng: np.random.Generator, size: Size) -> Image:
    """Paint a book's cover."""
    return front(random_brand(rng), size, rng)


def pages(rng: np.random.Generator, size: Size) -> Image:
    """Paint the edges of many sheets."""
    return tinted(hsv(rng, (0.08, 0.14), (0, 0.2), (0.8, 1)), 1 + 0.06 * noise(rng, size, 60, 0.7))


def paper(rng: np.random.Generator, size: Size) -> Image:
    """Paint a page: paragraphs of lines, sometimes a figure."""
    image = plain(rng, size, hsv(rng, (0.1, 0.15), (0, 0.1), (0.85, 1)), 0.01)
    rows, columns = size
    row = int(0.08 * rows)
    while row < 0.92 * rows:
        if rng.random() < 0.12:
            row += 8
        ink = int(rng.integers(20, 110))
        cv2.line(
            image, (int(0.1 * columns), row), (int(rng.uniform(0.6, 0.9) * columns), row), (ink, ink, ink), 1
        )
        row += int(rng.integers(4, 6))
    return image


def picture(rng: np.random.Generator, size: Size) -> Image:
    """Paint a photograph or a poster: sky, land, blobs."""
    sky, land = any_color(rng), any_color(rng)
    rows = np.linspace(0, 1, size[0])[:, None] + 0.08 * noise(rng, size, 30, 30)
    image = blended(sky, land, (rows - rng.uniform(0.3, 0.7)) * 10)
    for _ in range(rng.integers(0, 12)):
        color = [int(255 * c) for c in any_color(rng)]
        centre = int(rng.integers(size[1])), int(rng.integers(size[0]))
        axes = int(rng.integers(3, size[1] // 4)), int(rng.integers(3, size[0] // 4))
        cv2.ellipse(image, centre, axes, float(rng.uniform(0, 180)), 0, 360, color, -1)
    return image


def screen(rng: np.random.Generator, size: Size) -> Image:
    """Paint a display: off, windows with text, or a picture."""
    draw = rng.random()
    if draw < 0.4:
        return tinted((0.05, 0.05, 0.06), 1 + 0.5 * noise(rng, size, 30, 30))
    if draw < 0.6:
        return picture(rng, size)
    image = plain(rng, size, any_color(rng), 0.0)
    for _ in range(rng.integers(1, 4)):
        x, y = int(rng.uniform(0, 0.5) * size[1]), int(rng.uniform(0, 0.5) * size[0])
        w, h = int(rng.uniform(0.3, 0.7) * size[1]), int(rng.uniform(0.3, 0.7) * size[0])
        w, h = min(w, size[1] - x), min(h, size[0] - y)
        image[y : y + h, x : x + w] = paper(rng, (h, w)) if rng.random() < 0.7 else 30
        image[y : y + 5, x : x + w] = (60, 90, 160)
    return image


def keys(rng: np.random.Generator, size: Size) -> Image:
    """Paint rows of keys, buttons or slots."""
    dark = rng.random() < 0.7
    image = plain(rng, size, (0.08, 0.08, 0.08) if dark else (0.8, 0.8, 0.8))
    dy, dx = int(rng.integers(9, 26)), int(rng.integers(7, 26))
    low, high = (30, 70) if dark else (190, 250)
    for y in range(2, size[0] - dy, dy):
        for x in range(2, size[1] - dx, dx):
            grey = int(rng.integers(low, high))
            cv2.rectangle(image, (x, y), (x + dx - 3, y + dy - 3), (grey, grey, grey), -1)
            if rng.random() < 0.7:
                image[y + 2 : y + 4, x + 2 : x + 5] = 230 if dark else 30
    return image


def stickers(rng: np.random.Generator, size: Size) -> Image:
    """Paint a 3 x 3 grid of coloured squares with dark joints."""
    palette = np.array(
        [(200, 20, 30), (20, 150, 60), (20, 60, 180), (250, 220, 30), (250, 250, 250), (250, 120, 20)]
    )
    image = cv2.resize(
        palette[rng.integers(0, 6, (3, 3))].astype(np.uint8),
        (size[1], size[0]),
        interpolation=cv2.INTER_NEAREST,
    )
    for share in (0, 1 / 3, 2 / 3, 0.97):
        image[int(share * size[0]) : int(share * size[0]) + 4] = 15
        image[:, int(share * size[1]) : int(share * size[1]) + 4] = 15
    return image


def wicker(rng: np.random.Generator, size: Size) -> Image:
    """Paint woven canes or a perforated wall."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    pitch = rng.uniform(6, 14)
    weave = (
        np.sin(np.pi * columns / pitch)
        * np.sign(np.sin(np.pi * rows / pitch))
        * np.abs(np.sin(np.pi * rows / pitch))
    )
    return tinted(wood_color(rng), 0.85 + 0.25 * weave + 0.08 * noise(rng, size, 2, 2))


def bricks(rng: np.random.Generator, size: Size) -> Image:
    """Paint masonry or plain fired clay."""
    base = hsv(rng, (0.0, 0.07), (0.4, 0.75), (0.35, 0.75))
    image = tinted(base, 1 + 0.1 * noise(rng, size, 1, 1) + 0.1 * noise(rng, size, 8, 8))
    if rng.random() < 0.5:
        dy = int(rng.integers(12, 24))
        for index, y in enumerate(range(0, size[0], dy)):
            image[y : y + 2] = 175
            for x in range((index % 2) * dy, size[1], 2 * dy):
                image[y : y + dy, x : x + 2] = 175
    return image


def _mottled(hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float],
             fine: float = 0.04, coarse: float = 0.06) -> Painter:  # fmt: skip
    """Return a painter of one colour within bounds, with fine and coarse variation."""

    def paint(rng: np.random.Generator, size: Size) -> Image:
        tone = 1 + fine * noise(rng, size, 1.2, 1.2) + coarse * noise(rng, size, 14, 14)
        return tinted(hsv(rng, hue, saturation, value), tone)

    return paint


_FRUIT = (
    _mottled((0.95, 1.03), (0.6, 0.95), (0.4, 0.85), 0.03, 0.15),
    _mottled((0.18, 0.28), (0.5, 0.85), (0.45, 0.85), 0.03, 0.1),
    _mottled((0.06, 0.09), (0.8, 1.0), (0.8, 1.0), 0.04, 0.03),
    _mottled((0.13, 0.16), (0.6, 0.95), (0.8, 1.0), 0.03, 0.05),
)


def fruit(rng: np.random.Generator, size: Size) -> Image:
    """Paint the skin of an apple, pear, orange or lemon."""
    return _FRUIT[rng.integers(len(_FRUIT))](rng, size)


def liquid(rng: np.random.Generator, size: Size) -> Image:
    """Paint coffee, tea, milk, juice or soup."""
    bounds = (((0.05, 0.09), (0.5, 0.9), (0.08, 0.4)), ((0.08, 0.14), (0.0, 0.2), (0.85, 1.0)),
              ((0.02, 0.15), (0.5, 0.95), (0.5, 0.95)), ((0.5, 0.6), (0.0, 0.15), (0.6, 0.9)))  # fmt: skip
    return plain(rng, size, hsv(rng, *bounds[rng.integers(4)]), 0.01)


def food(rng: np.random.Generator, size: Size) -> Image:
    """Paint cereal, salad, rice, berries or soup with pieces."""
    first = hsv(rng, (-0.03, 0.32), (0.2, 0.9), (0.35, 1.0))
    second = hsv(rng, (-0.03, 0.32), (0.2, 0.9), (0.2, 1.0))
    scale = rng.uniform(2, 7)
    lumps = noise(rng, size, scale, scale)
    image = blended(first, second, 0.5 + 2 * noise(rng, size, scale, scale))
    return np.clip(image * (1 + 0.15 * lumps[..., None]), 0, 255).astype(np.uint8)


PAINTERS: dict[str, Painter] = {
    "wood": veneer, "fabric": fabric, "marble": marble, "leaf": leaf, "metal": steel, "cover": cover,
    "pages": pages, "paper": paper, "picture": picture, "screen": screen, "keys": keys, "stickers": stickers,
    "wicker": wicker, "brick": bricks, "fruit": fruit, "liquid": liquid, "food": food,
    "card": _mottled((0.07, 0.11), (0.25, 0.5), (0.5, 0.85), 0.02, 0.02),
    "plastic": _mottled((0.0, 1.0), (0.4, 1.0), (0.3, 0.95), 0.005, 0.02),
    "black": _mottled((0.5, 0.7), (0.0, 0.2), (0.03, 0.2), 0.05, 0.05),
    "white": _mottled((0.08, 0.15), (0.0, 0.08), (0.8, 1.0), 0.01, 0.02),
    "ceramic": _mottled((0.05, 0.65), (0.0, 0.25), (0.7, 1.0), 0.01, 0.02),
    "rubber": _mottled((0.0, 1.0), (0.0, 0.6), (0.05, 0.5), 0.03, 0.02),
    "clay": _mottled((0.03, 0.07), (0.45, 0.75), (0.5, 0.8), 0.04, 0.05),
    "soil": _mottled((0.05, 0.09), (0.3, 0.6), (0.1, 0.3), 0.3, 0.1),
    "skin": _mottled((0.02, 0.07), (0.25, 0.6), (0.3, 0.95), 0.02, 0.04),
    "bread": _mottled((0.06, 0.1), (0.4, 0.7), (0.45, 0.8), 0.06, 0.12),
    "banana": _mottled((0.12, 0.16), (0.6, 0.9), (0.75, 0.95), 0.02, 0.08),
    "foam": _mottled((0.0, 1.0), (0.1, 0.8), (0.5, 1.0), 0.08, 0.02),
}  # fmt: skip
_ANY = (
    "plastic",
    "wood",
    "fabric",
    "metal",
    "white",
    "black",
    "picture",
    "cover",
    "ceramic",
    "rubber",
    "marble",
)
