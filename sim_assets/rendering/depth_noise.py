"""Depth noise models: none, constant Gaussian, or a RealSense-like stereo camera.

The stereo model measures disparity ``d = f b / z``: an error of ``s`` pixels in d is an error of
``s z^2 / (f b)`` in depth, correlated over neighbouring pixels by the matching window; d is quantised.
Matching fails at grazing incidence, along depth edges, at random pixels, and below the minimum range.
"""

from __future__ import annotations

from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.types import CameraIntrinsics

DepthNoise = Literal["none", "gaussian", "realsense"]
DEPTH_NOISES: tuple[DepthNoise, ...] = get_args(DepthNoise)

GAUSSIAN_SIGMA = 0.002  # [m]
BASELINE = 0.05  # [m] between the stereo imagers
DISPARITY_SIGMA = 0.08  # [px]
DISPARITY_STEP = 1 / 32  # [px]
MATCHING_BLUR = 1.0  # [px], correlation of the disparity error
RANGE = (0.17, 6.0)  # [m]
DROPOUT = 0.002  # share of random pixels without depth
EDGE_STEP = 0.02  # [m] per pixel, depth gradient above which a pixel is on an edge
EDGE_LOSS = 0.6  # share of the pixels beside an edge without depth
GRAZING = (
    np.radians(72.0),
    np.radians(86.0),
)  # angles of incidence at which matching begins to fail and always fails


def add_depth_noise(
    depth: Float[np.ndarray, "h w"],
    noise: DepthNoise,
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w"]:
    """Return a noisy copy of a noise-free depth image in [m]; pixels without depth (0) stay 0.

    Raises:
        ValueError: the noise model is unknown.
    """
    if noise not in DEPTH_NOISES:
        raise ValueError(f"depth noise '{noise}' is none of {', '.join(DEPTH_NOISES)}")
    depth = depth.astype(np.float32)
    if noise == "none":
        return depth
    if noise == "gaussian":
        noisy = depth + GAUSSIAN_SIGMA * rng.standard_normal(depth.shape, dtype=np.float32)
        return np.where(depth > 0, np.maximum(noisy, 1e-3), 0).astype(np.float32)
    return _stereo(depth, intrinsics, rng)


def _stereo(
    depth: Float[np.ndarray, "h w"], intrinsics: CameraIntrinsics, rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    focal_baseline = intrinsics.fx * BASELINE
    valid = (depth > RANGE[0]) & (depth < RANGE[1])
    disparity = focal_baseline / np.where(valid, depth, 1.0)
    disparity += DISPARITY_SIGMA * _correlated(depth.shape, rng)
    disparity = np.maximum(np.round(disparity / DISPARITY_STEP), 1) * DISPARITY_STEP
    lost = rng.random(depth.shape, dtype=np.float32) < DROPOUT
    lost |= beside_edges(depth) & (_patchy(depth.shape, rng) < EDGE_LOSS)
    start, end = GRAZING
    failure = np.clip((incidence(depth, intrinsics) - start) / (end - start), 0, 1)
    lost |= _patchy(depth.shape, rng) < failure
    return np.where(valid & ~lost, focal_baseline / disparity, 0).astype(np.float32)


def _correlated(shape: tuple[int, ...], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return standard normal noise, correlated over the matching window."""
    blurred = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), MATCHING_BLUR)
    return blurred * (2 * np.sqrt(np.pi) * MATCHING_BLUR)  # restores unit standard deviation


def _patchy(shape: tuple[int, ...], rng: np.random.Generator) -> Float[np.ndarray, "h w"]:
    """Return uniform numbers in 0..1, constant over 2 x 2 pixels, so that holes are clustered."""
    half = rng.random(((shape[0] + 1) // 2, (shape[1] + 1) // 2), dtype=np.float32)
    return np.repeat(np.repeat(half, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]


def beside_edges(depth: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return the mask of pixels within two pixels of a depth discontinuity."""
    kernel = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > 2 * EDGE_STEP
    return cv2.dilate(jump.astype(np.uint8), kernel) > 0


def incidence(depth: Float[np.ndarray, "h w"], intrinsics: CameraIntrinsics) -> Float[np.ndarray, "h w"]:
    """Return the angle of incidence in [rad]: between each pixel's ray and the surface normal.

    With inverse depth q = 1/z over normalised image coordinates (x, y), a plane is q = a x + b y + c and its
    normal (a, b, c): the gradient of q alone gives the normal.
    """
    q = 1 / np.where(depth > 0, depth, 1e3).astype(np.float32)
    a = intrinsics.fx * cv2.Sobel(q, cv2.CV_32F, 1, 0, scale=1 / 8)
    b = intrinsics.fy * cv2.Sobel(q, cv2.CV_32F, 0, 1, scale=1 / 8)
    x = (np.arange(depth.shape[1], dtype=np.float32) - intrinsics.cx)[None, :] / intrinsics.fx
    y = (np.arange(depth.shape[0], dtype=np.float32) - intrinsics.cy)[:, None] / intrinsics.fy
    c = q - a * x - b * y
    cosine = np.abs(q) / (np.sqrt(a**2 + b**2 + c**2) * np.sqrt(1 + x**2 + y**2))
    return np.arccos(np.clip(cosine, 0, 1))
