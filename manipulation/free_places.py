"""Other places in the box, for an object whose planned place can no longer be reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull

from manipulation.footprints import BoxRaster, Footprint, Stencil, footprint
from manipulation.types import Box, Placement, StandingObject

GAPS = (0.012, 0.005)  # [m] smallest distance from walls and other objects; the smaller if there is no place
APART = 0.05  # [m] between two places
MOST = 4


def free_places(
    item: StandingObject,
    placement: Placement,
    others: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]],
    box: Box,
) -> list[Placement]:
    """Return places on the free floor of a box at the planned yaw, the one with most room around it first.

    Args:
        item: the object to be placed.
        placement: its planned goal.
        others: objects that may be in the box, with T_world_stand.
        box: the box.
    """
    raster = BoxRaster(box, 0.0)
    size = np.array(box.size[:2])
    for other, T_world_stand in others:
        points = other.vertices @ T_world_stand[:3, :3].T
        place = T_world_stand[:2, 3] - box.center
        if (np.abs(place) < size).all():
            outline = points[ConvexHull(points[:, :2]).vertices, :2]
            shape = Footprint((outline,), float(points[:, 2].max()))
            raster.add(Stencil.of(shape, 0.0, raster.cell), _cell(raster, place))
    room = np.asarray(distance_transform_edt(~raster.taken))
    shape = footprint(item).rotated(placement.yaws[0])
    free = (raster.free_positions(Stencil.of(shape, gap, raster.cell)) for gap in GAPS)
    room = np.where(next((places for places in free if places.any()), False), room, 0.0)
    found: list[Placement] = []
    while len(found) < MOST and room.any():
        i, j = np.unravel_index(np.argmax(room), room.shape)
        x, y = raster.centers[i, j] + box.center
        found.append(replace(placement, position=(float(x), float(y), box.floor)))
        room[np.linalg.norm(raster.centers - raster.centers[i, j], axis=-1) < APART] = 0.0
    return found


def _cell(raster: BoxRaster, place: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """Return the cell of a point relative to the centre of the box."""
    return int(np.abs(raster.x - place[0]).argmin()), int(np.abs(raster.y - place[1]).argmin())
