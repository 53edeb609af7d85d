"""Masks that show parts of one vessel, made one again.

A segmentation by geometry sees the outside of a vessel's near wall and the inside of its far wall as two
things: between them the near rim hides the rest. Seen from above they are two arcs of one circle, and their
rims are equally high; two vessels one behind the other reach much farther along the line of sight, and two
side by side share little of their width. Of a part that is small beside the other, as handles are, less is
asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from perception.detection.geometry import plane_axes, points_of
from perception.slam.pixels import label_image
from perception.types import Category, ObjectDetection, RgbdFrame, SupportPlane

VESSELS: tuple[Category, ...] = ("mug", "bowl")


@dataclass(frozen=True)
class FragmentConfig:
    """When two masks are one object.

    Attributes:
        border: pixels along which they touch, at least.
        top: difference of their highest points [m].
        stretch: of both together, along the line of sight over across it.
        largest: across both together [m].
        small: up to this share of the other one's pixels a part may stand beside it.
        common: of the narrower one's width across the line of sight, that larger parts have in common.
    """

    border: int = 8
    top: float = 0.02
    stretch: float = 1.25
    largest: float = 0.26
    small: float = 0.5
    common: float = 0.6


@dataclass(frozen=True)
class _Part:
    """The raised points of a mask in the plane's axes (n, 2), of how many, and how high they reach [m]."""

    plan: np.ndarray
    pixels: int
    top: float


def unite_fragments(
    frame: RgbdFrame,
    detections: Sequence[ObjectDetection],
    plane: SupportPlane,
    config: FragmentConfig = FragmentConfig(),
) -> list[ObjectDetection]:
    """The detections with parts of one vessel united; the largest part says class and yaw.

    Args:
        frame: with about the camera's pose, the plane's frame otherwise.
        detections: of one frame.
        plane: what the objects stand on.
        config: thresholds.
    """
    edges = [
        (a, b)
        for a, b in touching(label_image(detections, frame.depth.shape), config.border)
        if detections[a].category in VESSELS and detections[b].category in VESSELS
    ]
    if not edges:
        return list(detections)
    parts = {k: _part(frame, detections[k], plane) for k in {k for edge in edges for k in edge}}
    eye = np.eye(4) if frame.T_world_camera is None else frame.T_world_camera
    eye_plan = plane_axes(plane) @ eye[:3, 3]
    joined = [(a, b) for a, b in edges if _is_one(parts[a], parts[b], eye_plan, config)]
    n = len(detections)
    rows, columns = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    groups = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), False)[1]
    united = []
    for group in dict.fromkeys(groups):
        own = [detections[int(k)] for k in np.flatnonzero(groups == group)]
        main = max(own, key=lambda found: int(found.mask.sum()))
        mask = np.logical_or.reduce([found.mask for found in own])
        united.append(replace(main, mask=mask) if len(own) > 1 else main)
    return united


def touching(labels: UInt8[np.ndarray, "h w"], border: int) -> list[tuple[int, int]]:
    """Pairs of detections whose masks meet along ``border`` pixels or more, a pixel or two between them."""
    counts = np.zeros((256, 256), np.int64)
    for shift in (1, 3):
        for a, b in ((labels[:, :-shift], labels[:, shift:]), (labels[:-shift], labels[shift:])):
            differ = (a != b) & (a > 0) & (b > 0)
            low, high = np.minimum(a, b)[differ], np.maximum(a, b)[differ]
            pairs = np.bincount(low.astype(np.int64) * 256 + high, minlength=65536).reshape(256, 256)
            counts = np.maximum(counts, pairs)
    return [(int(a) - 1, int(b) - 1) for a, b in np.argwhere(counts >= border)]


def _part(frame: RgbdFrame, found: ObjectDetection, plane: SupportPlane) -> _Part | None:
    points = points_of(frame, found.mask)
    height = plane.height_above(points)
    raised = height > 0.005
    if raised.sum() < 20:
        return None
    step = max(1, int(raised.sum()) // 400)
    plan = points[raised][::step] @ plane_axes(plane).T
    return _Part(plan, int(raised.sum()), float(np.quantile(height[raised], 0.97)))


def _is_one(a: _Part | None, b: _Part | None, eye: np.ndarray, config: FragmentConfig) -> bool:
    """Whether two parts are arcs of one circle under one rim."""
    if a is None or b is None or abs(a.top - b.top) > config.top:
        return False
    both = np.concatenate([a.plan, b.plan])
    ahead = both.mean(axis=0) - eye
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    side = np.array([-ahead[1], ahead[0]])
    width, length = (float(np.ptp(np.quantile(both @ axis, (0.02, 0.98)))) for axis in (side, ahead))
    if not (length < config.stretch * width and max(width, length) < config.largest):
        return False
    if min(a.pixels, b.pixels) <= config.small * max(a.pixels, b.pixels):
        return True
    (low_a, high_a), (low_b, high_b) = (np.quantile(part.plan @ side, (0.02, 0.98)) for part in (a, b))
    narrower = min(high_a - low_a, high_b - low_b)
    return bool(min(high_a, high_b) - max(low_a, low_b) > config.common * narrower)
