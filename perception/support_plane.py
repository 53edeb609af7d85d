"""Support plane from depth images: RANSAC over three-point planes, then total least squares on the inliers.

It uses all frames with known poses (the plane is in the world frame) or a single frame without pose (its
camera is the world). Objects, the packing box and its floor are farther from the plane than the noise that
remains after a median filter, and are rejected as outliers in the refinement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from perception.detection.geometry import camera_pose, points_of
from perception.errors import InvalidInputError, PerceptionError
from perception.types import RgbdFrame, SupportPlane


@dataclass(frozen=True)
class PlaneConfig:
    """Parameters of the plane fit.

    Attributes:
        max_points: Number of depth points over all frames.
        iterations: Number of three-point hypotheses.
        judges: Number of points on which each hypothesis is scored.
        threshold: Largest distance of an inlier from a hypothesis, in metres.
        min_share: Smallest share of inliers of an accepted plane.
        max_tilt: Largest angle between the normal and world z for frames with poses, in radians.
        max_depth: Largest depth of a point, in metres.
    """

    max_points: int = 20_000
    iterations: int = 1000
    judges: int = 3000
    threshold: float = 0.006
    min_share: float = 0.1
    max_tilt: float = 0.35
    max_depth: float = 3.0


def fit_support_plane(
    frames: Sequence[RgbdFrame], config: PlaneConfig = PlaneConfig(), seed: int = 0
) -> SupportPlane:
    """Fit the plane with the most depth points; its normal points towards the cameras.

    Args:
        frames: Frames with poses, or a single one, whose pose may be unknown.
        config: Parameters.
        seed: Seed of the point sample and of RANSAC.

    Returns:
        The plane in the world frame; in the camera frame for a frame without pose.

    Raises:
        InvalidInputError: There is no frame, or one of several has no pose.
        PerceptionError: There are too few depth points, or no plane has enough inliers.
    """
    if not frames:
        raise InvalidInputError("no support plane without a frame; give at least one RGB-D frame")
    posed = all(frame.T_world_camera is not None for frame in frames)
    if len(frames) > 1 and not posed:
        raise InvalidInputError(
            f"a support plane from {len(frames)} frames needs T_world_camera of each; give one frame or poses"
        )
    rng = np.random.default_rng(seed)
    points = np.concatenate([_sample(f, config, config.max_points // len(frames), rng) for f in frames])
    if len(points) < 100:
        raise PerceptionError(
            f"No support plane: only {len(points)} depth points within {config.max_depth:g} m; "
            "check the depth images and their scale"
        )
    centres = np.stack([camera_pose(frame)[:3, 3] for frame in frames])
    min_up = np.cos(config.max_tilt) if posed else -1.0
    normal, offset = _ransac(points, centres.mean(0), min_up, config, rng)
    normal, offset = _refine(points, normal, offset, config)
    if (centres.mean(0) @ normal) < offset:
        normal, offset = -normal, -offset
    return SupportPlane(normal=normal, offset=float(offset))


def _sample(
    frame: RgbdFrame, config: PlaneConfig, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "n 3"]:
    """Return random world points of the median-filtered depth image."""
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 5)
    usable = np.flatnonzero((depth > 0) & (depth < config.max_depth))
    chosen = np.zeros(depth.size, dtype=bool)
    chosen[rng.choice(usable, size=min(count, len(usable)), replace=False)] = True
    return points_of(frame, chosen.reshape(depth.shape), depth)


def _ransac(
    points: Float[np.ndarray, "n 3"],
    centre: Float[np.ndarray, "3"],
    min_up: float,
    config: PlaneConfig,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the three-point plane with the most inliers, facing ``centre``, normal z at least ``min_up``."""
    a, b, c = points[rng.integers(len(points), size=(3, config.iterations))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals / np.maximum(length, 1e-12)[:, None]
    offsets = np.einsum("ij,ij->i", normals, a)
    flip = np.where(normals @ centre < offsets, -1.0, 1.0)
    normals, offsets = normals * flip[:, None], offsets * flip
    usable = (length > 1e-6) & (normals[:, 2] >= min_up)  # collinear points span no plane
    judges = points[rng.permutation(len(points))[: config.judges]].astype(np.float32)
    distance = judges @ normals.T.astype(np.float32) - offsets.astype(np.float32)
    support = np.where(usable, (np.abs(distance) < config.threshold).mean(0), 0.0)
    best = int(support.argmax())
    if support[best] < config.min_share:
        raise PerceptionError(
            f"No support plane: the best of {config.iterations} holds {support[best]:.0%} of {len(points)} "
            f"depth points, {config.min_share:.0%} are needed; show more of the table, or check the poses"
        )
    return normals[best], float(offsets[best])


def _refine(
    points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"], offset: float, config: PlaneConfig
) -> tuple[Float[np.ndarray, "3"], float]:
    """Refine by total least squares on the inliers within three robust standard deviations, iterated."""
    band = config.threshold
    for _ in range(6):
        distance = points @ normal - offset
        inliers = points[np.abs(distance) < band]
        mean = inliers.mean(0)
        refined = np.linalg.svd((inliers - mean).T @ (inliers - mean))[0][:, 2]
        normal = refined if refined @ normal > 0 else -refined
        offset = float(normal @ mean)
        spread = 1.4826 * float(np.median(np.abs(inliers @ normal - offset)))
        band = float(np.clip(3.0 * spread, 0.001, config.threshold))
    return normal, offset
