"""Parts of a mask that show the support surface beside an object.

Sensors with correlation windows smear the depth of an object over the table beside its base (stereo
fattening), and masks follow the depth. Such pixels are low above the table and beside the object in plan
view; low pixels of the object itself lie below its higher parts.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import bounding_window, linear_in_depth, plane_axes
from perception.types import RgbdFrame, SupportPlane

LOW = 0.012  # height up to which pixels may be of the surface, in metres
MARGIN = 0.010  # distance in plan view from the higher parts, from which on they are, in metres
_HIGHER = 0.3  # of the object's height: where its higher parts begin
_FLAT = 0.03  # objects lower than this keep their masks, in metres
_MIN_PIXELS = 30  # of the higher parts


def plan_image(frame: RgbdFrame, plane: SupportPlane) -> Float[np.ndarray, "H W 2"]:
    """Return the coordinates of every pixel's point along ``plane_axes``, in metres."""
    axes = [linear_in_depth(frame, axis) for axis in plane_axes(plane)]
    return np.stack([slope * frame.depth + np.float32(offset) for slope, offset in axes], axis=-1)


def without_table(
    mask: Bool[np.ndarray, "H W"],
    measured: Bool[np.ndarray, "H W"],
    height: Float[np.ndarray, "H W"],
    plan: Float[np.ndarray, "H W 2"],
) -> Bool[np.ndarray, "H W"]:
    """Return a mask without its low pixels that are not below the object's higher parts.

    Args:
        mask: Pixels of an object, at least one.
        measured: Pixels with depth; the others stay in the mask.
        height: Height of every pixel's point above the plane, in metres.
        plan: Coordinates of every pixel's point in the plane, in metres.
    """
    window = bounding_window(mask)
    inside, height, plan = mask[window] & measured[window], height[window], plan[window]
    low = inside & (height < LOW)
    if not low.any():
        return mask
    top = float(np.quantile(height[inside], 0.95))
    higher = inside & (height > max(2 * LOW, _HIGHER * top))
    if top < _FLAT or higher.sum() < _MIN_PIXELS:
        return mask
    result = mask.copy()
    result[window][low] = distance_outside(plan[low], plan[higher]) < MARGIN
    return result


def distance_outside(
    points: Float[np.ndarray, "n 2"], others: Float[np.ndarray, "m 2"]
) -> Float[np.ndarray, "n"]:
    """Return how far points are outside the convex hull of others: the largest distance from its sides.

    That is the distance from the hull, or less beside a corner; it is negative inside.

    Args:
        points: Points in the plane.
        others: Points that span the hull, not all on a line.
    """
    corners = cv2.convexHull(others.astype(np.float32), clockwise=False)[:, 0].astype(np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    outwards = np.stack([sides[:, 1], -sides[:, 0]], axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    return (points @ outwards.T - (corners * outwards).sum(axis=1)).max(axis=1)
