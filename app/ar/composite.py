"""Composites simulated objects into recorded images, with occlusion, shadows and soft edges.

Differential rendering (Debevec, 1998): a white scene is rendered with and without the toys; the ratio of the
two images is their shadow, which darkens the recorded image. A toy is visible where it is nearer than every
reconstruction (decided by the renderer) and nearer than the measured depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import RgbdFrame
from sim_assets.cell.drop_world import DropRendering

Image = UInt8[np.ndarray, "_h _w 3"]

TOLERANCE = 0.004  # [m] that a visible toy may lie behind the measured depth: noise and contact
SHADOW_BLUR = 2.2  # [px]
DARKEST = 0.45  # smallest share of light in a shadow
EDGE = 0.7  # [px] of blur of the border of a toy


@dataclass(frozen=True)
class Backdrop:
    """Static part of a view.

    Attributes:
        frame: Recorded image.
        bare: DropRendering of the white scene without toys.
        measured: Median-filtered depth in metres; 0 without a measurement.
    """

    frame: RgbdFrame
    bare: DropRendering
    measured: Float[np.ndarray, "h w"]

    @staticmethod
    def of(frame: RgbdFrame, bare: DropRendering) -> Backdrop:
        return Backdrop(frame, bare, cv2.medianBlur(np.ascontiguousarray(frame.depth), 5))


def composite(backdrop: Backdrop, now: DropRendering) -> Image:
    """Return the recorded image with the toys."""
    shown = visible_toys(backdrop, now)
    shadow = shadow_of(backdrop, now)
    image = backdrop.frame.rgb.astype(np.float32) * shadow[..., None]
    alpha = cv2.GaussianBlur(shown.astype(np.float32), (0, 0), EDGE)[..., None]
    image = (1 - alpha) * image + alpha * _bled(now.color, now.toys)
    return np.clip(image, 0, 255).astype(np.uint8)


def visible_toys(backdrop: Backdrop, now: DropRendering) -> Bool[np.ndarray, "h w"]:
    """Return the mask of the toys without the pixels that measured surfaces occlude."""
    hidden = (backdrop.measured > 0) & (now.depth > backdrop.measured + TOLERANCE)
    return now.toys & ~hidden


def shadow_of(backdrop: Backdrop, now: DropRendering) -> Float[np.ndarray, "h w"]:
    """Return the share of light, DARKEST to 1, that reaches each pixel past the toys."""
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
    """Extend the toys' colours over their antialiased borders, which are half white."""
    inner = cv2.erode(toys.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    weight = cv2.GaussianBlur(inner, (0, 0), 1.2)
    spread = cv2.GaussianBlur(color.astype(np.float32) * inner[..., None], (0, 0), 1.2)
    spread /= np.maximum(weight, 1e-4)[..., None]
    use = (inner == 0) & (weight > 1e-3)
    return np.where(use[..., None], spread, color.astype(np.float32))
