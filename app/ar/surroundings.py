"""Height field of everything on the support that is not reconstructed, from measured depth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from app.export.mjcf import upright
from perception.detection.geometry import points_of
from perception.errors import InvalidInputError
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane
from sim_assets.cell.drop_world import HeightField

CELL = 0.008  # [m]
REACH = 0.35  # [m] around the objects
FARTHEST = 5.0  # [m] of a reconstructed object from their middle
LOWEST, HIGHEST = 0.012, 0.35  # [m] above the support: noise below, no obstacle to toys above
APART = 0.02  # [m] around reconstructed objects, which have collision shapes of their own
LEAST_POINTS = 3  # per cell


def support_frame(objects: Sequence[ObjectEstimate], plane: SupportPlane) -> Float[np.ndarray, "4 4"]:
    """Return T_world_support: origin on the support below the centroid of the objects, z along its normal."""
    middle = np.mean([estimate.T_world_object[:3, 3] for estimate in objects], axis=0)
    T = np.eye(4)
    T[:3, :3] = upright(plane.normal)
    T[:3, 3] = middle - (middle @ plane.normal - plane.offset) * plane.normal
    return T


def clutter(
    frames: Sequence[RgbdFrame], objects: Sequence[ObjectEstimate], T_world_support: Float[np.ndarray, "4 4"]
) -> HeightField:
    """Return the heights of the measured surfaces around the objects, without the objects.

    Raises:
        InvalidInputError: An object is more than FARTHEST from the middle of the objects.
    """
    T_support_world = np.linalg.inv(T_world_support)
    footprints = [
        (T_support_world[:3, :3] @ estimate.mesh_world.vertices.T).T[:, :2] + T_support_world[:2, 3]
        for estimate in objects
    ]
    farthest = max(float(np.abs(points).max()) for points in footprints)
    if farthest > FARTHEST:
        raise InvalidInputError(
            f"an object is {farthest:.3g} m from the middle of the objects, at most {FARTHEST:g} m are "
            "allowed: reconstruct the scan again"
        )
    half = REACH + farthest
    count = 2 * int(np.ceil(half / CELL)) + 1
    own = np.zeros((count, count), np.uint8)
    for points in footprints:
        pixels = np.rint(points / CELL + count // 2).astype(np.int32)
        cv2.fillConvexPoly(own, cv2.convexHull(pixels), 1)
    border = 2 * int(np.ceil(APART / CELL)) + 1
    own = cv2.dilate(own, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (border, border)))
    heights = np.zeros((count, count))
    for frame in frames:
        heights = np.maximum(heights, _heights(frame, T_support_world, count))
    heights[own > 0] = 0.0
    return HeightField(heights, T_world_support, CELL)


def _heights(frame: RgbdFrame, T_support_world: np.ndarray, count: int) -> Float[np.ndarray, "c c"]:
    """Return the mean height of a frame's points above the support in each cell."""
    depth = cv2.medianBlur(np.ascontiguousarray(frame.depth), 5)
    points = points_of(frame, depth > 0, depth)
    local = points @ T_support_world[:3, :3].T + T_support_world[:3, 3]
    cell = np.rint(local[:, :2] / CELL).astype(int) + count // 2
    use = (
        (local[:, 2] > LOWEST)
        & (local[:, 2] < HIGHEST)
        & (cell >= 0).all(axis=1)
        & (cell < count).all(axis=1)
    )
    flat = cell[use, 1] * count + cell[use, 0]
    number = np.bincount(flat, minlength=count * count)
    total = np.bincount(flat, weights=local[use, 2], minlength=count * count)
    return np.where(number >= LEAST_POINTS, total / np.maximum(number, 1), 0.0).reshape(count, count)
