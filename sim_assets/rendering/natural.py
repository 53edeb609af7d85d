"""Natural textures: wood, cloth, stone, leaves, metal, canes, masonry, and noise."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from sim_assets.rendering.colors import any_color

Image = UInt8[np.ndarray, "h w 3"]
Size = tuple[int, int]
Painter = Callable[[np.random.Generator, Size], Image]


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


def mottled(hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float],
             fine: float = 0.04, coarse: float = 0.06) -> Painter:  # fmt: skip
    """Return a painter of one colour within bounds, with fine and coarse variation."""

    def paint(rng: np.random.Generator, size: Size) -> Image:
        tone = 1 + fine * noise(rng, size, 1.2, 1.2) + coarse * noise(rng, size, 14, 14)
        return tinted(hsv(rng, hue, saturation, value), tone)

    return paint
