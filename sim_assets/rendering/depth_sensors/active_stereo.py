"""Active stereo camera (RealSense D400): two infrared images of a projected dot pattern are matched.

The infrared pair is synthesised from colour and depth and matched with semi-global block matching, so that
shadows beside objects, fattened edges, holes without texture and at grazing incidence, quantisation and the
error z^2 s / (f b) come from the matching itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.parallax import UNSEEN, source_columns
from sim_assets.rendering.depth_sensors.surface import (
    NATIVE_FOCAL_LENGTH,
    Surface,
    box_mean,
    surface_of,
)

BASELINES = (0.05, 0.055)  # [m], D435 and D415
RANGE = (0.17, 8.0)  # [m]
MAX_DISPARITIES = 160
MARGIN = (0.0, 0.09)  # columns left of the image that the right imager sees, share of the width
SMOOTHED = 0.5  # share of cameras with the spatial filter on
SMOOTHING = (1.6, 0.6)  # [px], its radius and the largest change of disparity
AMBIENT = 0.3  # infrared light of the room, in full exposures of a white surface
DOT = 1.0  # light of a dot at DOT_DISTANCE and nearer
DOT_DISTANCE = 0.8  # [m]
DOT_DENSITY = 0.12  # dots per pixel
READ_NOISE = 1.2  # [grey levels]
SHOT_NOISE = 0.2  # [grey levels per root of a grey level]
BLOCKS = (7, 5)  # [px], of images with square pixels, and of those stretched along the rows
SPECKLE = 150  # [px], largest area of a patch that is removed
UNCERTAIN = 0.3  # [px], standard deviation from which a match is dropped
STEP = 1 / 32  # [px], of the measured disparity


@dataclass(frozen=True)
class StereoRig:
    """One camera of the series and its settings.

    Attributes:
        baseline: distance between the imagers in [m].
        margin: columns that the right imager sees beyond the left border, in [px].
        smoothing: whether disparities are smoothed on surfaces, as by the spatial post-processing filter.
    """

    baseline: float
    margin: float
    smoothing: bool


def active_stereo(
    depth: Float[np.ndarray, "h w"],
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
    rgb: UInt8[np.ndarray, "h w 3"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """Return the depth in [m] that an active stereo camera measures; 0 where it measures none."""
    baseline, margin = float(rng.choice(BASELINES)), float(rng.uniform(*MARGIN) * depth.shape[1])
    rig = StereoRig(baseline, margin, bool(rng.random() < SMOOTHED))
    surface = surface_of(rgb, depth.shape, rng)
    measured = (depth > RANGE[0]) & (depth < RANGE[1])
    if not measured.any() or min(depth.shape) < 9:
        return np.zeros_like(depth)
    stretch = max(1, round(NATIVE_FOCAL_LENGTH / intrinsics.fx))
    focal_baseline = stretch * intrinsics.fx * rig.baseline
    true = np.where(depth > 0, focal_baseline / np.where(depth > 0, depth, 1), 0).astype(np.float32)
    first = int(true[measured].min()) - 2
    count = int(np.ceil((true[measured].max() + 3 - first) / 16)) * 16
    count = min(count, MAX_DISPARITIES)
    left, right = infrared_pair(_widen(depth, stretch), _widen(true, stretch), first + count, surface, rng)
    block = BLOCKS[0] if stretch == 1 else BLOCKS[1]
    disparity = match(left, right, first, count, block)[:, first + count :][:, ::stretch]
    columns = stretch * np.arange(depth.shape[1], dtype=np.float32)
    found = measured & (disparity > first)
    if rig.smoothing:
        disparity = _smoothed(disparity, found, intrinsics.fx / NATIVE_FOCAL_LENGTH)
    valid = found & (columns - disparity >= -rig.margin * stretch)
    return np.where(valid, focal_baseline / np.where(valid, disparity, 1), 0).astype(np.float32)


def _widen(image: Float[np.ndarray, "h w"], factor: int) -> Float[np.ndarray, "h w2"]:
    """Insert ``factor`` - 1 columns after each one; interpolated, but not across depth edges."""
    if factor == 1:
        return image
    following = np.concatenate([image[:, 1:], image[:, -1:]], axis=1)
    step = following - image
    step[np.abs(step) > 0.03 * np.abs(image)] = 0
    shares = np.arange(factor, dtype=np.float32) / factor
    return (image[..., None] + step[..., None] * shares).reshape(len(image), -1)


def infrared_pair(
    depth: Float[np.ndarray, "h w"],
    disparity: Float[np.ndarray, "h w"],
    pad: int,
    surface: Surface,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "h w2"], UInt8[np.ndarray, "h w2"]]:
    """Return the rectified infrared images, both wider by ``pad`` columns on the left.

    The left image is that of the depth image; the right one is warped from it.
    """
    height, width = depth.shape
    if surface.albedo.shape != depth.shape:
        surface = Surface(*(cv2.resize(i, depth.shape[::-1]) for i in (surface.albedo, surface.highlight)))
    columns = np.arange(width, dtype=np.float32)
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], width, axis=1)
    pattern = dot_pattern(height, width + MAX_DISPARITIES)
    # The projector sits in the middle between the imagers: it sees a point half the disparity further left.
    dots = cv2.remap(pattern, columns - disparity / 2 + MAX_DISPARITIES / 2, rows, cv2.INTER_LINEAR)
    distance = np.where(depth > 0, np.maximum(depth, DOT_DISTANCE), 1e3)
    light = AMBIENT + DOT * dots * (DOT_DISTANCE / distance) ** 2
    image = 255 * (surface.albedo * light.astype(np.float32) + surface.highlight)
    source = source_columns(disparity, pad)
    rows = np.repeat(np.arange(height, dtype=np.float32)[:, None], source.shape[1], axis=1)
    right = cv2.remap(image, source, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    right[source <= UNSEEN] = 0.1 * float(image.mean())  # what only the right eye sees has no dots
    left = cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE)
    return expose(left, rng), expose(right, rng)


def expose(image: Float[np.ndarray, "h w"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w"]:
    """Return the image as the sensor reads it: with read and shot noise, saturated at 255."""
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise *= READ_NOISE + SHOT_NOISE * np.sqrt(image)
    return cv2.add(image, noise, dtype=cv2.CV_8U)


@lru_cache(maxsize=8)
def dot_pattern(height: int, width: int) -> Float[np.ndarray, "h w"]:
    """Return the projector's pattern, the same for every image: random dots of brightness 0 to 1."""
    dots = (np.random.default_rng(0).random((height, width)) < DOT_DENSITY).astype(np.float32)
    dots = np.minimum(4.0 * cv2.GaussianBlur(dots, (0, 0), 0.8), 1)
    dots.flags.writeable = False
    return dots


def match(
    left: UInt8[np.ndarray, "h w"], right: UInt8[np.ndarray, "h w"], first: int, count: int, block: int
) -> Float[np.ndarray, "h w"]:
    """Return the disparity of the left image in [px] by semi-global block matching; ``first`` - 1 is none.

    Args:
        left, right: rectified images.
        first, count: smallest disparity and number of disparities (a multiple of 16) in [px].
        block: side of the blocks in [px].
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=first, numDisparities=count, blockSize=block, P1=4 * block**2, P2=24 * block**2,
        disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=8, speckleWindowSize=SPECKLE, speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(left, right).astype(np.float32) / 16
    return _refined(left, right, disparity, first, block)


def _smoothed(
    disparity: Float[np.ndarray, "h w"], found: Bool[np.ndarray, "h w"], scale: float
) -> Float[np.ndarray, "h w"]:
    """Average disparities over a few pixels of one surface; small steps become slopes, large ones stay."""
    radius, limit = SMOOTHING
    sigma = max(radius * scale, 0.5)
    known = cv2.GaussianBlur(found.astype(np.float32), (0, 0), sigma)
    mean = cv2.GaussianBlur(np.where(found, disparity, 0), (0, 0), sigma) / np.maximum(known, 1e-3)
    mean = np.rint(mean / np.float32(STEP)) * np.float32(STEP)
    return np.where(np.abs(mean - disparity) < limit, mean, disparity)


def _refined(
    left: UInt8[np.ndarray, "h w"],
    right: UInt8[np.ndarray, "h w"],
    disparity: Float[np.ndarray, "h w"],
    first: int,
    block: int,
) -> Float[np.ndarray, "h w"]:
    """Refine the disparity by a least-squares step over each block, which removes the bias to whole pixels.

    With the right image R and residual r = left - R(x - d), the step is - sum(r R') / sum(R'^2) and its
    standard deviation sqrt(mean(r^2) / sum(R'^2)); too uncertain matches are dropped.
    """
    rows = np.repeat(np.arange(left.shape[0], dtype=np.float32)[:, None], left.shape[1], axis=1)
    columns = np.arange(left.shape[1], dtype=np.float32) - disparity
    right = right.astype(np.float32)
    slope = cv2.remap(cv2.Sobel(right, -1, 1, 0, ksize=1, scale=0.5), columns, rows, cv2.INTER_LINEAR)
    residual = left - cv2.remap(right, columns, rows, cv2.INTER_LINEAR)
    power = box_mean(slope * slope, block) + 1e-3
    step = -box_mean(residual * slope, block) / power
    uncertainty = box_mean(residual * residual, block) / power
    refined = disparity + np.clip(step, -0.5, 0.5)
    refined = np.rint(refined / np.float32(STEP)) * np.float32(STEP)
    certain = (disparity >= first) & (uncertainty < block**2 * UNCERTAIN**2)
    return np.where(certain, refined, np.float32(first - 1))
