"""Candidates of no class that look as in the round before: they were judged then.

The images of two rounds are taken from the same viewpoints. Where nothing near a candidate has moved since,
and nothing in front of it, its fits would be repeated on the same measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import plan_coordinates, points_of
from perception.pipeline import Detections
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

SAME_VIEW = 0.003  # [m] and [rad] between two poses of the camera
CHANGED = 0.015  # [m] between the depths of a pixel, from which on something has moved
NEAR = 0.03  # [m] in plan view from what has moved or was left, within which a candidate is judged again
FEW = 0.02  # share of a candidate's points that may be near it
_CELL = 0.005  # [m] in which changed points are counted
_LEAST = 4  # changed points in a cell: fewer are noise
_POINTS = 500  # of a candidate


def with_judged(
    detections: Detections,
    frames: Sequence[RgbdFrame],
    before: Sequence[RgbdFrame],
    left: Sequence[ObjectEstimate] = (),
) -> Detections:
    """Return the detections with the candidates marked that look as they did in images taken before.

    Args:
        detections: Detections in the images.
        frames: Images with camera poses, without the robot.
        before: Images of the round before; without one from each of the same viewpoints nothing is marked.
        left: Objects that were found then and were not placed: they are fitted again.
    """
    pairs = [(_from_same_view(frame, before), frame) for frame in frames]
    changed = [_changes(old, new, detections.plane) for old, new in pairs if old is not None]
    if not frames or len(changed) < len(frames):
        return detections
    cells, count = np.unique(
        np.floor(np.concatenate(changed) / _CELL).astype(np.int64), axis=0, return_counts=True
    )
    places = [(cells[count >= _LEAST] + 0.5) * _CELL]
    places += [plan_coordinates(estimate.mesh_world.vertices, detections.plane) for estimate in left]
    tree = KDTree(np.concatenate(places)) if any(len(place) for place in places) else None

    def is_unchanged(frame: RgbdFrame, mask: Bool[np.ndarray, "h w"]) -> bool:
        if tree is None:
            return True
        points = points_of(frame, mask)
        plan = plan_coordinates(points[:: max(1, len(points) // _POINTS)], detections.plane)
        return len(plan) > 0 and bool((tree.query(plan)[0] < NEAR).mean() <= FEW)

    return replace(
        detections,
        left_out=tuple(
            replace(candidate, was_judged=is_unchanged(frames[candidate.frame], candidate.mask))
            for candidate in detections.left_out
        ),
    )


def _from_same_view(frame: RgbdFrame, others: Sequence[RgbdFrame]) -> RgbdFrame | None:
    """Return the image that was taken from where another one was; None without one."""
    assert frame.T_world_camera is not None
    same = (
        other
        for other in others
        if other.T_world_camera is not None
        and other.intrinsics == frame.intrinsics
        and np.abs(other.T_world_camera - frame.T_world_camera).max() < SAME_VIEW
    )
    return next(same, None)


def _changes(before: RgbdFrame, after: RgbdFrame, plane: SupportPlane) -> Float[np.ndarray, "n 2"]:
    """Return the plan coordinates [m] of what only one of two images from the same viewpoint shows."""
    old, new = clean_frame(before), clean_frame(after)
    is_measured = (old.depth > 0) & (new.depth > 0)
    differs = is_measured & (np.abs(old.depth - new.depth) > CHANGED)
    opened = cv2.morphologyEx(differs.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    points = np.concatenate([points_of(old, opened), points_of(new, opened)])
    return plan_coordinates(points, plane)
