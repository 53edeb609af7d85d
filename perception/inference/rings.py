"""Rings that look like mugs, such as rolls of tape: what they stand on is seen through them.

A mug has a floor, of 3 mm and more.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool

from perception.detection.geometry import points_of
from perception.inference.observation import ObjectObservation
from perception.types import ObjectEstimate, SupportPlane

_MIDDLE = 0.2  # radii from the axis within which the floor is looked for
_FLOOR = 0.0012  # [m] above the support, from which on the median height there is that of a floor
_BELOW = 0.004  # [m] below it, from which on points are errors of the depth
_LEAST = 60  # points in the middle


def is_ring(estimate: ObjectEstimate, observations: Sequence[ObjectObservation], plane: SupportPlane) -> bool:
    """Return whether an upright mug has no floor: the support is seen where that would be.

    Args:
        estimate: The estimate.
        observations: Views of the object; what their masks surround is looked at as well.
        plane: What the object rests on.
    """
    if estimate.category != "mug" or estimate.resting != "upright":
        return False
    seen = [points_of(view.frame, _surrounded(view) & (view.frame.depth > 0)) for view in observations]
    points = np.concatenate([np.zeros((0, 3)), *seen])
    away = np.linalg.norm(points[:, :2] - estimate.T_world_object[:2, 3], axis=1)
    height = plane.height_above(points[away < _MIDDLE * estimate.radius])
    height = height[(height > -_BELOW) & (height < estimate.height)]
    return len(height) >= _LEAST and float(np.median(height)) < _FLOOR


def _surrounded(view: ObjectObservation) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the convex hull of a mask."""
    v, u = np.nonzero(view.mask)
    hull = np.zeros(view.mask.shape, np.uint8)
    if len(v):
        cv2.fillConvexPoly(hull, cv2.convexHull(np.column_stack([u, v]).astype(np.int32)), 1)
    return hull > 0
