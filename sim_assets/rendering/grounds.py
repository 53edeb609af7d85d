"""Tables and floors: wood, stone, cloth, carpet, masonry, tiles, card and paint."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import cv2
import numpy as np

from sim_assets.rendering.colors import Color, Texture, mixed, random_color, to_bytes
from sim_assets.rendering.natural import bricks, fabric, marble, noise, plain, tinted, veneer


def wood(rng: np.random.Generator, color: Color, size: tuple[int, int] = (512, 512)) -> Texture:
    """Return a texture of planks with grain along the rows' direction."""
    rows, columns = size
    planks = 6
    image = np.empty((rows, columns, 3), dtype=np.float32)
    base = np.array(color, dtype=np.float32)
    bounds = np.linspace(0, rows, planks + 1).astype(int)
    for start, stop in itertools.pairwise(bounds):
        noise = rng.standard_normal((stop - start, columns), dtype=np.float32)
        grain = cv2.GaussianBlur(
            noise, (0, 0), sigmaX=columns / 10, sigmaY=1.1, borderType=cv2.BORDER_REFLECT
        )
        waves = cv2.GaussianBlur(
            noise[::-1], (0, 0), sigmaX=columns / 5, sigmaY=7, borderType=cv2.BORDER_REFLECT
        )
        tone = 1 + 0.035 * grain / grain.std() + 0.03 * waves / waves.std() + rng.normal(0, 0.035)
        image[start:stop] = base * tone[..., None]
        image[start : start + 1] *= 0.72  # the joint between two planks
    return (255 * np.clip(image, 0, 1)).astype(np.uint8)


def cardboard(rng: np.random.Generator, color: Color, size: tuple[int, int] = (128, 128)) -> Texture:
    """Return a texture of fine fibres with low contrast."""
    noise = cv2.GaussianBlur(rng.standard_normal(size, dtype=np.float32), (0, 0), sigmaX=4, sigmaY=0.8)
    tone = 1 + 0.018 * noise / noise.std()
    return (255 * np.clip(np.array(color) * tone[..., None], 0, 1)).astype(np.uint8)


def random_ground(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return a texture of a table or a floor: wood, stone, cloth, carpet, masonry, tiles, card or paint."""
    kind = _GROUNDS[rng.choice(len(_GROUNDS), p=_GROUND_SHARES)]
    return kind(rng, size)


def _ground_colors(rng: np.random.Generator) -> tuple[Color, Color]:
    """Sample two colours of a ground: mostly brown, grey or white."""
    if rng.random() < 0.6:
        warm, cold = rng.uniform(0.2, 1.0), rng.uniform(0.6, 1.0)
        grey = 0.9 * warm
        return (warm, warm * rng.uniform(0.65, 1.0), warm * cold * 0.8), (grey, grey, grey)
    return random_color(rng, True), random_color(rng, True)


def planks(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return planks in any of the ground's colours."""
    return wood(rng, _ground_colors(rng)[0], size)


def parquet(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return a floor of short boards in a basket or brick bond, each with its own tone."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    wide = int(rng.integers(10, 30))
    if rng.random() < 0.5:
        row = rows // wide
        column = (columns + (row * 37) % 61) // (4 * wide)
        joint = rows % wide == 0
    else:
        turned = (rows // (3 * wide) + columns // (3 * wide)) % 2 == 1
        row, column = (
            np.where(turned, columns // wide, rows // wide),
            rows // (3 * wide) + 7 * (columns // (3 * wide)),
        )
        joint = np.where(turned, columns % wide, rows % wide) == 0
    tone = 1 + 0.1 * np.sin(12.9898 * row + 78.233 * column + rng.uniform(0, 6))
    grained = veneer(rng, size) * (tone * (1 - 0.25 * joint))[..., None]
    return np.clip(grained, 0, 255).astype(np.uint8)


def stone(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return smooth noise between two colours."""
    color, other = _ground_colors(rng)
    field = cv2.GaussianBlur(rng.standard_normal(size, dtype=np.float32), (0, 0), rng.uniform(1, 12))
    share = np.clip(0.5 + 0.25 * field / field.std(), 0, 1)[..., None]
    return (share * to_bytes(color) + (1 - share) * to_bytes(other)).astype(np.uint8)


def tiles(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return tiles of two colours, or of one with joints."""
    color, other = _ground_colors(rng)
    row, column = np.mgrid[: size[0], : size[1]]
    side = int(rng.integers(12, 64))
    if rng.random() < 0.5:
        return mixed(color, other, (row // side + column // side) % 2 == 0)
    return mixed(other, color, (row % side < 2) | (column % side < 2))


def carpet(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return carpet or concrete: one colour with strong fine and weak coarse noise."""
    fine, coarse = rng.uniform(0.02, 0.2), rng.uniform(0.01, 0.08)
    tone = 1 + fine * noise(rng, size, 1, 1) + coarse * noise(rng, size, 25, 25)
    return tinted(_ground_colors(rng)[0], tone)


def paint(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return a single colour."""
    return np.broadcast_to(to_bytes(_ground_colors(rng)[0]), (*size, 3)).copy()


def laminate(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return a plain or faintly uneven board: white, grey, beech."""
    return plain(rng, size, _ground_colors(rng)[0], rng.uniform(0, 0.04))


def card(rng: np.random.Generator, size: tuple[int, int]) -> Texture:
    """Return card in any of the ground's colours."""
    return cardboard(rng, _ground_colors(rng)[0], size)


_GROUNDS: tuple[Callable[[np.random.Generator, tuple[int, int]], Texture], ...] = (
    planks, veneer, parquet, stone, marble, tiles, fabric, carpet, bricks, paint, laminate, card,
)  # fmt: skip
_GROUND_SHARES = (0.12, 0.16, 0.07, 0.06, 0.08, 0.07, 0.12, 0.08, 0.02, 0.06, 0.12, 0.04)
