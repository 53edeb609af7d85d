"""Colours: the palette of glazes, paints and prints, and textures of two colours."""

from __future__ import annotations

import colorsys

import numpy as np
from jaxtyping import Bool, UInt8

Color = tuple[float, float, float]
Texture = UInt8[np.ndarray, "h w 3"]

# Palette of glazes, paints and prints: (hue, saturation, value).
_PALETTE = (
    (0.00, 0.82, 0.75), (0.60, 0.80, 0.70), (0.13, 0.85, 0.90), (0.38, 0.70, 0.58), (0.08, 0.85, 0.90),
    (0.79, 0.60, 0.55), (0.51, 0.75, 0.68), (0.10, 0.05, 0.93), (0.95, 0.45, 0.85), (0.58, 0.35, 0.80),
    (0.30, 0.45, 0.70), (0.07, 0.55, 0.45), (0.62, 0.55, 0.30), (0.11, 0.22, 0.85),
)  # fmt: skip


def random_color(rng: np.random.Generator, anything: bool) -> Color:
    """Sample a colour of the palette with small variations, or any colour."""
    if anything:
        return any_color(rng)
    hue, saturation, value = _PALETTE[rng.integers(len(_PALETTE))]
    jitter = rng.normal(0, (0.012, 0.05, 0.04))
    return colorsys.hsv_to_rgb(
        (hue + jitter[0]) % 1,
        float(np.clip(saturation + jitter[1], 0, 1)),
        float(np.clip(value + jitter[2], 0, 1)),
    )


def any_color(rng: np.random.Generator) -> Color:
    """Sample a colour of any hue, saturation and value."""
    return colorsys.hsv_to_rgb(rng.random(), rng.random() ** 0.7, rng.uniform(0.05, 1.0))


def to_bytes(color: Color) -> UInt8[np.ndarray, "3"]:
    """Return a colour in 0..1 as bytes."""
    return np.round(255 * np.clip(np.array(color), 0, 1)).astype(np.uint8)


def to_tuple(color: UInt8[np.ndarray, "3"]) -> tuple[int, int, int]:
    """Return bytes as the plain integers that OpenCV draws with."""
    return int(color[0]), int(color[1]), int(color[2])


def mixed(body: Color, accent: Color, where: Bool[np.ndarray, "h w"]) -> Texture:
    """Return the accent where asked and the body elsewhere."""
    return np.where(where[..., None], to_bytes(accent), to_bytes(body)).astype(np.uint8)
