"""Places on the table that no image has shown, in which an object may stand unseen.

Behind objects, and beyond the borders of few images, something may be hidden. Where that place is wide enough
for an object, further images are taken from where they show it, if any of the scan's viewpoints are left, and
the table is looked at once more when all that was seen is done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from manipulation.viewpoints import Viewpoint
from perception.detection.geometry import in_image, points_of, project
from perception.inference.depth_votes import Region
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

CELL = 0.005  # [m] of the grid of places
HEIGHT = 0.03  # [m] above the table at which they are looked at: an object that is hidden is hidden there
BEFORE = 0.015  # [m] by which what is measured is nearer than a place that it hides, at least
OUTLINE = 0.01  # [m] around a known object, in which nothing else stands
NARROWEST = 0.022  # [m] radius of the thinnest objects
_CELLS = 48  # across an imagined image: 1 cm at the distance of the scan


def may_hide_an_object(
    frames: Sequence[RgbdFrame],
    objects: Sequence[ObjectEstimate],
    area: Region,
    plane: SupportPlane = SupportPlane(),
) -> bool:
    """Return whether an object may stand on the table where no image has shown anything.

    Args:
        frames: Images of the table with camera poses.
        objects: Known objects as they stood then.
        area: Ranges of x and y [m] in which objects stand.
        plane: Surface of the table.
    """
    return widest_hidden(frames, objects, area, plane) > NARROWEST


def widest_hidden(
    frames: Sequence[RgbdFrame],
    objects: Sequence[ObjectEstimate],
    area: Region,
    plane: SupportPlane = SupportPlane(),
) -> float:
    """Return the radius [m] of the largest circle of places beside the objects that no image shows.

    Args:
        frames, objects, area, plane: As those of ``may_hide_an_object``.
    """
    places = _Places.of(objects, area, plane)
    return places.widest(_hidden(frames, places))


def revealing_viewpoints(
    frames: Sequence[RgbdFrame],
    objects: Sequence[ObjectEstimate],
    area: Region,
    viewpoints: Sequence[Viewpoint],
    plane: SupportPlane = SupportPlane(),
) -> list[Viewpoint]:
    """Return viewpoints that together show where an object may be hidden, the most revealing first.

    What hides a place from a viewpoint is what the images have measured above it, wherever it belongs to.

    Args:
        frames, objects, area, plane: As those of ``may_hide_an_object``; at least one image.
        viewpoints: Viewpoints without an image so far.

    Returns:
        No more than are needed, and none that shows less than an object covers.
    """
    places = _Places.of(objects, area, plane)
    hidden = _hidden(frames, places)
    points = np.concatenate([_measured(frame) for frame in frames])
    points = points[plane.height_above(points) > HEIGHT]
    camera = frames[0].intrinsics
    reach = min(camera.width / camera.fx, camera.height / camera.fy) / 2
    shown = {viewpoint: _would_show(viewpoint, places.points, points, reach) for viewpoint in viewpoints}
    chosen = []
    while shown and places.widest(hidden) > NARROWEST:
        best = max(shown, key=lambda viewpoint: int((hidden & places.beside & shown[viewpoint]).sum()))
        revealed = hidden & places.beside & shown.pop(best)
        if revealed.sum() * CELL**2 < np.pi * NARROWEST**2:
            break
        chosen.append(best)
        hidden &= ~revealed
    return chosen


@dataclass(frozen=True)
class _Places:
    """A grid of places above the table.

    Attributes:
        points: World coordinates [m].
        beside: Which are beside the known objects.
        shape: Rows and columns of the grid.
    """

    points: Float[np.ndarray, "n 3"]
    beside: Bool[np.ndarray, "n"]
    shape: tuple[int, int]

    @staticmethod
    def of(objects: Sequence[ObjectEstimate], area: Region, plane: SupportPlane) -> _Places:
        """Return the places of a region of x and y [m]."""
        (x0, x1), (y0, y1) = area
        x, y = np.meshgrid(np.arange(x0, x1, CELL), np.arange(y0, y1, CELL))
        on_plane = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        on_plane -= plane.height_above(on_plane)[:, None] * plane.normal
        free = np.ones(x.shape, np.uint8)
        for estimate in objects:
            outline = estimate.mesh_world.vertices[:, :2]
            hull = cv2.convexHull((((outline - (x0, y0)) / CELL).round()).astype(np.int32))
            mask = cv2.fillConvexPoly(np.zeros_like(free), hull, 1)
            around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(OUTLINE / CELL) + 1,) * 2)
            free[cv2.dilate(mask, around) > 0] = 0
        return _Places(on_plane + HEIGHT * plane.normal, free.reshape(-1) > 0, x.shape)

    def widest(self, hidden: Bool[np.ndarray, "n"]) -> float:
        """Return the radius [m] of the largest circle of hidden places beside the objects."""
        free = (hidden & self.beside).reshape(self.shape).astype(np.uint8)
        return CELL * float(cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, 5).max())


def _hidden(frames: Sequence[RgbdFrame], places: _Places) -> Bool[np.ndarray, "n"]:
    """Return which places no image shows."""
    hidden = np.ones(len(places.points), bool)
    for frame in frames:
        hidden &= ~_shown(frame, places.points)
    return hidden


def _measured(frame: RgbdFrame) -> Float[np.ndarray, "n 3"]:
    """Return the world points [m] measured at every fourth pixel of every fourth row."""
    mask = np.zeros(frame.depth.shape, bool)
    mask[::4, ::4] = True
    return points_of(frame, mask & (frame.depth > 0))


def _would_show(
    viewpoint: Viewpoint, places: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"], reach: float
) -> Bool[np.ndarray, "n"]:
    """Return the places that an image would show from a viewpoint, whatever the roll of the camera.

    Args:
        viewpoint: Pose of the camera.
        places: World coordinates [m].
        points: Points [m] that hide what is behind them.
        reach: Tangent of the angle between the optical axis and the nearest border of the image.
    """
    T = viewpoint.camera_pose()

    def cells_of(world: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y, depth = ((world - T[:3, 3]) @ T[:3, :3]).T
        depth = np.maximum(depth, 1e-6)
        inside = (np.hypot(x, y) < reach * depth) & (depth > 1e-3)
        cells = np.clip((np.stack([x, y]) / (reach * depth) + 1) / 2 * _CELLS, 0, _CELLS - 1).astype(int)
        return _CELLS * cells[0] + cells[1], depth, inside

    nearest = np.full(_CELLS**2, np.inf)
    cells, depth, inside = cells_of(points)
    np.minimum.at(nearest, cells[inside], depth[inside])
    cells, depth, inside = cells_of(places)
    return np.asarray(inside & (nearest[cells] > depth - BEFORE))


def _shown(frame: RgbdFrame, places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return the places in an image before which nothing is measured."""
    pixels, depth = project(frame, places)
    shown = in_image(frame, pixels, depth)
    u, v = pixels[shown].T
    measured = frame.depth[v, u]
    shown[shown] = (measured > 0) & (measured > depth[shown] - BEFORE)
    return shown
