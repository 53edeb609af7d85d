"""Surfaces of things by name: wood, fabric, marble, leaves, steel, skin, prints; atlases of them."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sim_assets.rendering.colors import any_color
from sim_assets.rendering.natural import (
    Image,
    Painter,
    Size,
    blended,
    bricks,
    fabric,
    hsv,
    leaf,
    marble,
    mottled,
    noise,
    plain,
    steel,
    tinted,
    veneer,
    wicker,
)
from sim_assets.rendering.packaging import Brand, front, random_brand, side, top
from sim_assets.rendering.texture_coordinates import ATLAS, CELLS

ATLAS_SIZE = (256, 384)  # rows, columns of the texture of a distractor
PRINTED = (front, side, top)


def atlas(surfaces: Sequence[str], rng: np.random.Generator, wild: float = 0.0) -> Image:
    """Paint the cells of an atlas, first row at the bottom.

    Args:
        surfaces: names of the cells' surfaces, keys of PAINTERS or "print"; three prints in a row are the
            front, side and top of one package. Unknown names get any surface; missing cells stay black.
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


_FRUIT = (
    mottled((0.95, 1.03), (0.6, 0.95), (0.4, 0.85), 0.03, 0.15),
    mottled((0.18, 0.28), (0.5, 0.85), (0.45, 0.85), 0.03, 0.1),
    mottled((0.06, 0.09), (0.8, 1.0), (0.8, 1.0), 0.04, 0.03),
    mottled((0.13, 0.16), (0.6, 0.95), (0.8, 1.0), 0.03, 0.05),
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
    first = hsv(rng, (-0.03, 0.3), (0.2, 0.75), (0.35, 0.95))
    second = hsv(rng, (-0.03, 0.3), (0.2, 0.75), (0.2, 0.95))
    scale = rng.uniform(2, 7)
    lumps = noise(rng, size, scale, scale)
    image = blended(first, second, 0.5 + 2 * noise(rng, size, scale, scale))
    return np.clip(image * (1 + 0.15 * lumps[..., None]), 0, 255).astype(np.uint8)


PAINTERS: dict[str, Painter] = {
    "wood": veneer, "fabric": fabric, "marble": marble, "leaf": leaf, "metal": steel, "cover": cover,
    "pages": pages, "paper": paper, "picture": picture, "screen": screen, "keys": keys, "stickers": stickers,
    "wicker": wicker, "brick": bricks, "fruit": fruit, "liquid": liquid, "food": food,
    "card": mottled((0.07, 0.11), (0.25, 0.5), (0.5, 0.85), 0.02, 0.02),
    "plastic": mottled((0.0, 1.0), (0.4, 1.0), (0.3, 0.95), 0.005, 0.02),
    "black": mottled((0.5, 0.7), (0.0, 0.2), (0.03, 0.2), 0.05, 0.05),
    "white": mottled((0.08, 0.15), (0.0, 0.08), (0.8, 1.0), 0.01, 0.02),
    "ceramic": mottled((0.05, 0.65), (0.0, 0.25), (0.7, 1.0), 0.01, 0.02),
    "rubber": mottled((0.0, 1.0), (0.0, 0.6), (0.05, 0.5), 0.03, 0.02),
    "clay": mottled((0.03, 0.07), (0.45, 0.75), (0.5, 0.8), 0.04, 0.05),
    "soil": mottled((0.05, 0.09), (0.3, 0.6), (0.1, 0.3), 0.3, 0.1),
    "skin": mottled((0.02, 0.07), (0.25, 0.6), (0.3, 0.95), 0.02, 0.04),
    "bread": mottled((0.06, 0.1), (0.4, 0.7), (0.45, 0.8), 0.06, 0.12),
    "banana": mottled((0.12, 0.16), (0.6, 0.9), (0.75, 0.95), 0.02, 0.08),
    "foam": mottled((0.0, 1.0), (0.1, 0.8), (0.5, 1.0), 0.08, 0.02),
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
