"""Ends of lying bottles and cans that their masks lack, such as a neck or a cap.

The networks may end a mask where the shape or the colour changes. Measured points that no shape explains and
that go on along the axis, no farther from it than the shape's own end, are of the same object. What is beside
the axis is not, unlike the handles of mugs (``lost_parts``): a thing that touches the object.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.depth_cleaning import beside_jumps, clean_frame
from perception.detection.geometry import bounding_window, height_image, points_of
from perception.inference.lost_parts import ABOVE, FAR, JUMP, MIN_PIXELS, SAMPLES, Rows
from perception.metrics import SurfaceSamples
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

REACH = 1.0  # how far from a mask its ends, and what goes on beyond them, are looked for, in its longer sides
LONGEST = 0.08  # [m] of an end
GAP = 0.015  # [m] along the axis between the shape and an end of it
END = 0.015  # [m] along the axis, of which the widest section is that of the shape's end
WITHIN = 0.8  # least share of the pixels of a lost end that are no farther from the axis than that

Mask = Bool[np.ndarray, "h w"]


def with_lost_ends(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    ids: Sequence[int],
    plane: SupportPlane,
) -> dict[int, list[Mask | None]]:
    """Return the masks of lying objects with the ends that they lack, None where none shows, by id.

    To a mask that lacks an end belongs all that the object's shape explains. Objects of which fewer than two
    views show a lost end are left out, unless there is one view alone.

    Args:
        frames: Images with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates of all objects, by id.
        ids: Lying objects of round section whose ends are looked for.
        plane: Support plane.
    """
    if not ids:
        return {}
    rng = np.random.default_rng(0)
    surfaces = {id: SurfaceSamples.of(e.mesh_world, rng, SAMPLES).points for id, e in estimates.items()}
    cleaned = [clean_frame(frame) for frame in frames]
    found: dict[int, list[Mask | None]] = {}
    for id in ids:
        others = [points for other, points in surfaces.items() if other != id]
        body = _Body.of(estimates[id], surfaces[id], np.concatenate([np.full((1, 3), 1e6), *others]))
        masks: list[Mask | None] = [None] * len(frames)
        for k, (frame, row) in enumerate(zip(cleaned, rows, strict=True)):
            own = next((d.mask for d in row if d.instance_id == id), None)
            if own is not None:
                masks[k] = body.with_ends(frame, own, plane)
        if sum(mask is not None for mask in masks) >= min(2, len(frames)):
            found[id] = masks
    return found


@dataclass(frozen=True)
class _Body:
    """A lying object and what is around it.

    Attributes:
        centre, axis: Its axis in the world frame, the first in metres.
        ends: Where it begins and ends along the axis, in metres from the centre.
        radii: Largest distance from the axis at each end, in metres.
        surface, others: Points of its surface, and of those of other objects.
    """

    centre: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    ends: tuple[float, float]
    radii: tuple[float, float]
    surface: KDTree
    others: KDTree

    @staticmethod
    def of(estimate: ObjectEstimate, surface: np.ndarray, others: np.ndarray) -> _Body:
        centre, axis = estimate.T_world_object[:3, 3], estimate.T_world_object[:3, 2]
        along, aside = _coordinates(surface, centre, axis)
        low, high = float(along.min()), float(along.max())
        radii = float(aside[along < low + END].max()), float(aside[along > high - END].max())
        return _Body(centre, axis, (low, high), radii, KDTree(surface), KDTree(others))

    def with_ends(self, frame: RgbdFrame, mask: Mask, plane: SupportPlane) -> Mask | None:
        """Return a mask with the ends that it lacks in one view; None if that shows none."""
        rows, columns = bounding_window(mask)
        reach = int(REACH * max(rows.stop - rows.start, columns.stop - columns.start)) + 1
        window = bounding_window(mask, reach)
        seen = np.zeros_like(mask)
        seen[window] = frame.depth[window] > 0
        seen &= height_image(frame, plane) > ABOVE
        points = points_of(frame, seen)
        if not len(points):
            return None
        to_own = self.surface.query(points, distance_upper_bound=2 * FAR)[0]
        to_others = self.others.query(points, distance_upper_bound=2 * FAR)[0]
        unknown, own = seen.copy(), seen.copy()
        unknown[seen] = (to_own > FAR) & (to_others > FAR)
        own[seen] = (to_own <= FAR) & (to_own < to_others)
        unknown &= ~beside_jumps(unknown, frame.depth, JUMP)
        labels = cv2.connectedComponents(unknown.astype(np.uint8))[1]
        is_end = np.zeros_like(mask)
        on_axis, is_next = np.zeros_like(mask), np.zeros_like(mask)
        on_axis[seen], is_next[seen] = self._continued(points)
        for label in np.unique(labels[is_next & (labels > 0)]):
            piece = labels == label
            if piece.sum() >= MIN_PIXELS and (piece & on_axis).sum() >= WITHIN * piece.sum():
                is_end |= piece
        return mask | own | is_end if is_end.any() else None

    def _continued(
        self, points: Float[np.ndarray, "n 3"]
    ) -> tuple[Bool[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
        """Return which world points go on along the axis, and which of these begin at the shape."""
        along, aside = _coordinates(points, self.centre, self.axis)
        beyond = np.where(along < 0, self.ends[0] - along, along - self.ends[1])
        radius = np.where(along < 0, *self.radii)
        on_axis = (beyond > 0) & (beyond < LONGEST) & (aside < radius + FAR)
        return on_axis, on_axis & (beyond < GAP)


def _coordinates(
    points: Float[np.ndarray, "n 3"], centre: Float[np.ndarray, "3"], axis: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the positions of points along an axis, from its centre, and their distances from it [m]."""
    relative = points - centre
    along = relative @ axis
    return along, np.linalg.norm(relative - along[:, None] * axis, axis=1)
