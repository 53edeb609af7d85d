"""Merging of masks that are fragments of one vessel.

Geometric segmentation splits a mug or bowl into the outside of its near wall and the inside of its far wall,
since the near rim occludes what lies between. Seen from above, the two are arcs of one circle, and their
rims are equally high. Two vessels one behind the other extend much farther along the line of sight, and two
side by side overlap little across it. A fragment that is small beside the other, such as a handle, need not
overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import plane_axes, points_of
from perception.slam.labelled_frame import label_image
from perception.types import Category, ObjectDetection, RgbdFrame, SupportPlane

VESSELS: tuple[Category, ...] = ("mug", "bowl")
_MIN_HEIGHT = 0.005  # [m] above the plane: lower points may be of the table
_MIN_POINTS = 20
_MAX_POINTS = 400  # about as many are kept
_TOP_QUANTILE = 0.97
_EXTENT_QUANTILES = (0.02, 0.98)


@dataclass(frozen=True)
class MaskMergingConfig:
    """Conditions under which two masks are fragments of one vessel.

    Attributes:
        min_contact: Least length of their common border, in pixels.
        max_top_difference: Largest difference of the heights of their tops, in metres.
        max_elongation: Largest extent of both along the line of sight, relative to that across it.
        max_size: Largest extent of both, in metres.
        small_ratio: Number of pixels relative to the other's up to which a fragment need not overlap.
        min_overlap: Least overlap across the line of sight, relative to the narrower fragment's width.
    """

    min_contact: int = 8
    max_top_difference: float = 0.02
    max_elongation: float = 1.25
    max_size: float = 0.26
    small_ratio: float = 0.5
    min_overlap: float = 0.6


@dataclass(frozen=True)
class _Fragment:
    """Points of a mask above the plane.

    Attributes:
        plan: Subsampled coordinates of the points along the plane's axes, in metres.
        n_pixels: Number of points before subsampling.
        top: Height of the highest points above the plane, in metres.
    """

    plan: Float[np.ndarray, "n 2"]
    n_pixels: int
    top: float


def merge_masks(
    frame: RgbdFrame,
    detections: Sequence[ObjectDetection],
    plane: SupportPlane,
    config: MaskMergingConfig = MaskMergingConfig(),
) -> list[ObjectDetection]:
    """Return the detections with the fragments of each vessel merged; the largest determines class and yaw.

    Args:
        frame: The image with its approximate camera pose; without one, the plane is in the camera frame.
        detections: Detections in the frame.
        plane: Support plane.
        config: Thresholds.
    """
    edges = [
        (a, b)
        for a, b in adjacent_masks(label_image(detections, frame.depth.shape), config.min_contact)
        if detections[a].category in VESSELS and detections[b].category in VESSELS
    ]
    if not edges:
        return list(detections)
    fragments = {k: _fragment(frame, detections[k], plane) for k in {k for edge in edges for k in edge}}
    T_plane_camera = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
    eye = plane_axes(plane) @ T_plane_camera[:3, 3]
    same = [(a, b) for a, b in edges if _is_one_vessel(fragments[a], fragments[b], eye, config)]
    n = len(detections)
    rows, columns = np.array(same, dtype=np.int64).reshape(-1, 2).T
    groups = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), False)[1]
    merged = []
    for group in dict.fromkeys(groups):
        own = [detections[int(k)] for k in np.flatnonzero(groups == group)]
        main = max(own, key=lambda found: int(found.mask.sum()))
        mask = np.logical_or.reduce([found.mask for found in own])
        merged.append(replace(main, mask=mask) if len(own) > 1 else main)
    return merged


def adjacent_masks(labels: UInt8[np.ndarray, "h w"], min_contact: int) -> list[tuple[int, int]]:
    """Return pairs (a, b), a < b, of detections that are adjacent along ``min_contact`` pixels or more.

    Adjacent are pixels that are one or three apart along a row or a column, so a gap of two is bridged.
    """
    counts = np.zeros((256, 256), np.int64)
    for shift in (1, 3):
        for a, b in ((labels[:, :-shift], labels[:, shift:]), (labels[:-shift], labels[shift:])):
            differ = (a != b) & (a > 0) & (b > 0)
            low, high = np.minimum(a, b)[differ], np.maximum(a, b)[differ]
            pairs = np.bincount(low.astype(np.int64) * 256 + high, minlength=65536).reshape(256, 256)
            counts = np.maximum(counts, pairs)
    return [(int(a) - 1, int(b) - 1) for a, b in np.argwhere(counts >= min_contact)]


def _fragment(frame: RgbdFrame, found: ObjectDetection, plane: SupportPlane) -> _Fragment | None:
    """Return the points of a mask above the plane, None if there are too few."""
    points = points_of(frame, found.mask)
    height = plane.height_above(points)
    raised = height > _MIN_HEIGHT
    if raised.sum() < _MIN_POINTS:
        return None
    step = max(1, int(raised.sum()) // _MAX_POINTS)
    plan = points[raised][::step] @ plane_axes(plane).T
    return _Fragment(plan, int(raised.sum()), float(np.quantile(height[raised], _TOP_QUANTILE)))


def _is_one_vessel(
    a: _Fragment | None, b: _Fragment | None, eye: Float[np.ndarray, "2"], config: MaskMergingConfig
) -> bool:
    """Return whether two fragments are arcs of one circle below one rim, seen from ``eye`` in the plane."""
    if a is None or b is None or abs(a.top - b.top) > config.max_top_difference:
        return False
    both = np.concatenate([a.plan, b.plan])
    ahead = both.mean(axis=0) - eye
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    side = np.array([-ahead[1], ahead[0]])
    width, length = (float(np.ptp(np.quantile(both @ axis, _EXTENT_QUANTILES))) for axis in (side, ahead))
    if not (length < config.max_elongation * width and max(width, length) < config.max_size):
        return False
    if min(a.n_pixels, b.n_pixels) <= config.small_ratio * max(a.n_pixels, b.n_pixels):
        return True
    (low_a, high_a), (low_b, high_b) = (np.quantile(x.plan @ side, _EXTENT_QUANTILES) for x in (a, b))
    narrower = min(high_a - low_a, high_b - low_b)
    return bool(min(high_a, high_b) - max(low_a, low_b) > config.min_overlap * narrower)
