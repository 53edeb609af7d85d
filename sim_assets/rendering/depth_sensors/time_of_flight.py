"""Time-of-flight camera (Azure Kinect), registered to colour.

Flying pixels between two surfaces, noise and bias that depend on the light that returns, cavities rounded by
light that took other paths, and holes where too little light returns.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.parallax import hidden_from
from sim_assets.rendering.depth_sensors.surface import (
    NATIVE_FOCAL_LENGTH,
    correlated,
    depth_edges,
    incidence,
    patchy,
    ramp,
    surface_of,
)

CAMERA = -0.032  # [m], depth camera along the colour camera's x axis
RANGE = (0.25, 5.5)  # [m]
FOOTPRINT = 0.7  # [px], standard deviation of the area that a pixel averages over
EDGE = 0.015  # relative jump of depth at an edge
EDGE_LOSS = 0.35  # share of the edge pixels that the camera recognises as invalid
NOISE = (0.0005, 0.0003, 0.02)  # [m]: constant, of a white surface at 1 m, and largest standard deviation
BIAS = (0.006, 0.45)  # [m] per unit of albedo below the second value; dark surfaces look farther
SCATTER = (-0.08, 0.16)  # range of the share of light from the surroundings of a concave place
SCATTER_RADIUS = 14.0  # [px]
SCATTER_LIMIT = 0.01  # [m], largest displacement
DARK = (0.012, 0.004)  # amplitudes (albedo cos / z^2, in 1/m^2) at which holes begin and all light is lost
GRAZING = (0.12, 0.05)  # cosines of incidence likewise


def time_of_flight(
    depth: Float[np.ndarray, "h w"],
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
    rgb: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Return the depth in [m] that a time-of-flight camera measures; 0 where it measures none."""
    scale = intrinsics.fx / NATIVE_FOCAL_LENGTH
    surface = surface_of(rgb, depth.shape, rng)
    seen = depth > 0
    z = np.where(seen, depth, 1e3)
    cosine = incidence(depth, intrinsics)
    amplitude = surface.albedo * cosine / z**2
    failure = np.maximum(ramp(amplitude, *DARK), ramp(cosine, *GRAZING))
    lost = patchy(depth.shape, 6 * scale, rng) < np.maximum(failure, 0.7 * surface.highlight)
    lost |= hidden_from(np.float32(CAMERA * intrinsics.fx) / z)
    measured = _scattered(depth, seen, scale, float(rng.uniform(*SCATTER)))
    measured, edge = _mixed(measured, amplitude, scale, rng)
    lost |= edge & (rng.random(depth.shape, dtype=np.float32) < EDGE_LOSS)
    constant, white, largest = NOISE
    sigma = np.minimum(constant + white * z**2 / np.maximum(surface.albedo * cosine, 0.03), largest)
    measured += sigma * rng.standard_normal(depth.shape, dtype=np.float32)
    slope, neutral = BIAS
    measured += slope * (neutral - surface.albedo)
    measured += 0.001 * correlated(depth.shape, depth.shape[1] / 5, rng)
    valid = seen & ~lost & (measured > RANGE[0]) & (measured < RANGE[1])
    return np.where(valid, measured, 0).astype(np.float32)


def _mixed(
    depth: Float[np.ndarray, "h w"],
    amplitude: Float[np.ndarray, "h w"],
    scale: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "h w"], np.ndarray]:
    """Mix depths at edges over a pixel's footprint, by the light they return; also return those edges."""
    edge = depth_edges(depth, EDGE)
    weight = np.where(depth > 0, amplitude + 1e-6, 0).astype(np.float32)
    sigma = max(FOOTPRINT * scale, 0.45)
    total = cv2.GaussianBlur(weight, (0, 0), sigma)
    mean = cv2.GaussianBlur(weight * depth, (0, 0), sigma) / np.maximum(total, 1e-9)
    jitter = np.float32(0.5 * scale)
    columns = np.arange(depth.shape[1], dtype=np.float32)[None, :] + jitter * correlated(depth.shape, 1, rng)
    rows = np.arange(depth.shape[0], dtype=np.float32)[:, None] + jitter * correlated(depth.shape, 1, rng)
    mean = cv2.remap(mean, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(edge & (mean > 0), mean, depth), edge


def _scattered(
    depth: Float[np.ndarray, "h w"], seen: np.ndarray, scale: float, share: float
) -> Float[np.ndarray, "h w"]:
    """Displace concave places towards (``share`` > 0) or away from the mean inverse depth around them.

    Inverse depth is linear over the image of a plane, which therefore stays as it is.
    """
    q = np.where(seen, 1 / np.where(seen, depth, 1), 0).astype(np.float32)
    small = tuple(max(n // 4, 1) for n in depth.shape[::-1])
    sigma = SCATTER_RADIUS * scale / 4
    known = cv2.resize(seen.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    around = cv2.GaussianBlur(cv2.resize(q, small, interpolation=cv2.INTER_AREA), (0, 0), sigma)
    around /= np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), 0.05)
    around = cv2.resize(around, depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    depth_of_cavity = depth - 1 / np.maximum(around, 1e-3)
    displacement = np.clip(share * np.maximum(depth_of_cavity, 0), -SCATTER_LIMIT, SCATTER_LIMIT)
    return np.where(seen, depth - displacement, 0).astype(np.float32)
