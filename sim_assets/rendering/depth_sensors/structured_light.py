"""Structured-light camera (Kinect v1, Xtion), registered to colour.

Lateral noise and the noise beyond 1 m: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D
reconstruction and tracking" (3DIMPVT 2012; axial 1.9 mm at 1 m, 6.1 mm at 2 m). Order of the effects (local
shifts, noise of the disparity, quantisation): Handa et al., "A benchmark for RGB-D visual odometry" (ICRA
2014).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.parallax import hidden_from
from sim_assets.rendering.depth_sensors.surface import (
    Surface,
    correlated,
    depth_edges,
    incidence,
    patchy,
    ramp,
    surface_of,
)

BASELINE = 0.075  # [m] from the infrared camera to the projector
CAMERA = -0.025  # [m], infrared camera along the colour camera's x axis; the projector is at +0.05
FOCAL_LENGTH = 580.0  # [px] of the infrared camera, at which figures in pixels hold
STEP = 1 / 8  # [px] of disparity
RANGE = (0.35, 4.0)  # [m]
AXIAL = 0.05  # [px], standard deviation of the disparity: with the steps 1.4 mm at 1 m, 5.6 mm at 2 m
LATERAL = 0.8  # [px], standard deviation of the position of an edge
DISTORTION = 0.07  # [px], standard deviation of the smooth error of the disparity
FATTENED = 0.5  # share of the outlines widened by a pixel
GRAZING = (0.22, 0.07)  # cosines of incidence at which matching begins to fail and always fails
DARK = (0.03, 0.006)  # amplitudes (albedo / z^2, in 1/m^2) at which it begins to fail and always fails
BORDER = 0.11  # largest empty share of the width at the right border
EDGE = 0.03  # relative jump of disparity at an edge
MIXED = 0.25  # share of the pixels at a depth edge that measure both surfaces


def structured_light(
    depth: Float[np.ndarray, "h w"],
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
    rgb: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Return the depth in [m] that a structured-light camera measures; 0 where it measures none."""
    scale = intrinsics.fx / FOCAL_LENGTH
    focal_baseline = np.float32(intrinsics.fx * BASELINE)
    surface = surface_of(rgb, depth.shape, rng)
    seen = depth > 0
    disparity = np.where(seen, focal_baseline / np.where(seen, depth, 1), 0).astype(np.float32)
    lost = hidden_from(disparity * np.float32(CAMERA / BASELINE))
    lost |= hidden_from(disparity * np.float32(1 + CAMERA / BASELINE))
    lost |= _fails(depth, intrinsics, surface, scale, rng)
    disparity[lost] = 0
    disparity = _ragged(disparity, scale, rng)
    seen &= disparity > 0
    disparity += AXIAL * scale * correlated(depth.shape, max(1.5 * scale, 1), rng)
    disparity += DISTORTION * scale * correlated(depth.shape, depth.shape[1] / 5, rng)
    step = np.float32(STEP * scale)
    steps = np.maximum(np.rint(disparity / step), 1)
    z = focal_baseline / (steps * step)
    valid = seen & (z > RANGE[0]) & (z < RANGE[1]) & ~_border(depth.shape, rng)
    return np.where(valid, z, 0).astype(np.float32)


def _ragged(
    disparity: Float[np.ndarray, "h w"], scale: float, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """Widen outlines, mix both surfaces at some edge pixels, and displace edges."""
    shape = disparity.shape
    near = cv2.dilate(disparity, np.ones((3, 3), np.uint8))
    edge = (near > disparity * np.float32(1 + EDGE)) & _beside_edges(disparity)
    share = patchy(shape, 3 * scale, rng)
    wide = np.where(edge & (share < FATTENED), near, disparity)
    mixed = edge & (share > 1 - MIXED) & (disparity > 0)
    weight = rng.random(shape, dtype=np.float32)
    wide = np.where(mixed, weight * near + (1 - weight) * disparity, wide)
    columns = np.arange(shape[1], dtype=np.float32)[None, :]
    rows = np.arange(shape[0], dtype=np.float32)[:, None]
    sigma = np.float32(LATERAL * scale)
    columns = columns + sigma * correlated(shape, max(3 * scale, 1), rng)
    rows = rows + sigma * correlated(shape, max(3 * scale, 1), rng)
    return cv2.remap(wide, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _beside_edges(disparity: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    depth = np.where(disparity > 0, 1 / np.where(disparity > 0, disparity, 1), 0).astype(np.float32)
    return depth_edges(depth, EDGE)


def _fails(
    depth: Float[np.ndarray, "h w"],
    intrinsics: CameraIntrinsics,
    surface: Surface,
    scale: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Return where the pattern is not recognised: at grazing incidence, on dark and on shiny surfaces."""
    z = np.where(depth > 0, depth, 1e3)
    failure = ramp(incidence(depth, intrinsics), *GRAZING)
    failure = np.maximum(failure, ramp(surface.albedo / z**2, *DARK))
    failure = np.maximum(failure, surface.highlight)
    return patchy(depth.shape, 6 * scale, rng) < failure


def _border(shape: tuple[int, int], rng: np.random.Generator) -> Bool[np.ndarray, "h w"]:
    """Return the border of the image that the infrared camera or the projector does not see."""
    height, width = shape
    border = np.ones(shape, dtype=bool)
    left, top, bottom = (rng.uniform(0, 0.012, 3) * width).astype(int)
    right = int(rng.uniform(0, BORDER) * width)
    border[top : height - bottom, left : width - right] = False
    return border
