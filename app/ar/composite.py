"""Simulated things put into recorded images: what is in front of what, shadows, soft edges.

Differential rendering: the same white world is rendered with and without the toys; where the two differ, the
toys cast a shadow, and the recorded image is darkened by that ratio. A toy's pixel is shown where the toy is
nearer than every reconstruction, which the renderer sees to, and nearer than the depth measured there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import RgbdFrame
from sim_assets.cell.drop_world import Rendering

Image = UInt8[np.ndarray, "_h _w 3"]

TOLERANCE = 0.004  # [m] that a toy may lie behind the measured depth: noise, and it touches what was measured
SHADOW_BLUR = 2.2  # [px]
DARKEST = 0.45  # a shadow leaves this much light
EDGE = 0.7  # [px] over which a toy's border fades


@dataclass(frozen=True)
class Backdrop:
    """What stays the same in a view while toys fall.

    Attributes:
        frame: the recorded image.
        bare: the white world without toys.
        measured: the recorded depth, its speckle removed [m]; 0 where nothing was measured.
    """

    frame: RgbdFrame
    bare: Rendering
    measured: Float[np.ndarray, "h w"]

    @staticmethod
    def of(frame: RgbdFrame, bare: Rendering) -> Backdrop:
        return Backdrop(frame, bare, cv2.medianBlur(np.ascontiguousarray(frame.depth), 5))


def composite(backdrop: Backdrop, now: Rendering) -> Image:
    """The recorded image with the toys in it."""
    shown = visible_toys(backdrop, now)
    shadow = shadow_of(backdrop, now)
    image = backdrop.frame.rgb.astype(np.float32) * shadow[..., None]
    alpha = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), EDGE)[..., None]
    image = (1 - alpha) * image + alpha * _bled(now.color, now.toys)
    return np.clip(image, 0, 255).astype(np.uint8)


def visible_toys(backdrop: Backdrop, now: Rendering) -> Bool[np.ndarray, "h w"]:
    """Where a toy is nearer than reconstructions and measured depth."""
    hidden = (backdrop.measured > 0) & (now.depth > backdrop.measured + TOLERANCE)
    return now.toys & ~hidden


def shadow_of(backdrop: Backdrop, now: Rendering) -> Float[np.ndarray, "h w"]:
    """The share of light, DARKEST to 1, that the toys leave to what they stand on or before."""
    before = backdrop.bare.color.astype(np.float32).mean(axis=-1)
    after = now.color.astype(np.float32).mean(axis=-1)
    known = (~cv2.dilate(now.toys.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)).astype(
        np.float32
    )
    share = np.clip((after + 1) / (before + 1), DARKEST, 1.0)
    weight = cv2.GaussianBlur(known, (0, 0), SHADOW_BLUR)
    blurred = cv2.GaussianBlur(share * known, (0, 0), SHADOW_BLUR) / np.maximum(weight, 1e-3)
    return np.where(weight > 0.02, blurred, 1.0)


def _bled(color: Image, toys: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """The toys' colours carried over their antialiased borders, which are half white."""
    inner = cv2.erode(toys.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    weight = cv2.GaussianBlur(inner, (0, 0), 1.2)
    spread = cv2.GaussianBlur(color.astype(np.float32) * inner[..., None], (0, 0), 1.2)
    spread /= np.maximum(weight, 1e-4)[..., None]
    use = (inner == 0) & (weight > 1e-3)
    return np.where(use[..., None], spread, color.astype(np.float32))
