"""Other places in the box, for an object whose planned place is too narrow or can no longer be reached."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial import ConvexHull

from manipulation.footprints import BoxRaster, Footprint, Stencil, footprint
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.robot import GripperGeometry
from manipulation.standing import split_handle
from manipulation.types import Box, Grasp, Placement, StandingObject

GAPS = (0.012, 0.005)  # [m] smallest distance from walls and other objects; the smaller if there is no place
ENOUGH = 0.008  # [m] from what is in the box, with which the planned place is kept
NARROW = (0.012, 0.008, 0.005, 0.003)  # [m] distances that a place beside it may keep instead, tried in order
BESIDE = 0.03  # [m] of it from the planned place
BETWEEN = 0.003  # [m] that it keeps from the goals of objects that are not yet in the box
APART = 0.05  # [m] between two places
SNUG = 0.05  # [m] around an object, within which the free floor is counted
MOST = 4
_YAWS = 2  # of a place at which the hand is looked at: grasps of round objects are all around them


@dataclass(frozen=True)
class Hold:
    """How the hand may hold an object that it releases.

    Attributes:
        grasps: grasps of the object.
        gripper: geometry of the hand.
    """

    grasps: Sequence[Grasp]
    gripper: GripperGeometry

    def has_room(self, place: Placement, raster: BoxRaster, box: Box) -> bool:
        """Return whether some grasp is above the scene at a place.

        Args:
            place: goal of the object.
            raster: heights of the scene.
            box: the box.
        """
        position, base = np.subtract(place.position[:2], box.center), place.position[2] + place.release_height
        poses = [ReleasePose(position, yaw, base) for yaw in place.yaws[:_YAWS]]
        return any(count_free_releases(raster, self.grasps, pose, self.gripper) for pose in poses)


def free_places(
    item: StandingObject,
    placement: Placement,
    others: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]],
    box: Box,
    waiting: Sequence[tuple[StandingObject, Placement]] = (),
    is_snug: bool = False,
    hold: Hold | None = None,
) -> list[Placement]:
    """Return places on the free floor of a box at the planned yaw, the one with most or least room first.

    They leave the goals of waiting objects free if there is such a place. Those at which the hand has no room
    to release the object come last.

    Args:
        item: the object to be placed.
        placement: its planned goal.
        others: objects that may be in the box, with T_world_stand.
        box: the box.
        waiting: objects that are not yet in the box, with their goals.
        is_snug: whether the place with the least room around it comes first, which leaves more to others.
        hold: how the hand may hold the object; None if it need not have room.
    """
    filled = _filled(box, others)
    if waiting:
        reserved = _reserved(filled.copy(), box, waiting)
        if places := _free_places(item, placement, reserved, box, is_snug, hold):
            return places
    return _free_places(item, placement, filled, box, is_snug, hold)


def _free_places(
    item: StandingObject,
    placement: Placement,
    raster: BoxRaster,
    box: Box,
    is_snug: bool,
    hold: Hold | None,
) -> list[Placement]:
    """Return places on the cells of a raster that are not taken, the one with most or least room first."""
    shape = footprint(item).rotated(placement.yaws[0])
    if is_snug:
        rank = 1.0 / (1.0 + raster.free_within(Stencil.of(shape, SNUG, raster.cell)))
    else:
        rank = np.asarray(distance_transform_edt(~raster.taken))
    free = (raster.free_positions(Stencil.of(shape, gap, raster.cell)) for gap in GAPS)
    rank = np.where(next((places for places in free if places.any()), False), rank, 0.0)
    found: list[Placement] = []
    without_room: list[Placement] = []
    while len(found) < MOST and rank.any():
        i, j = np.unravel_index(np.argmax(rank), rank.shape)
        x, y = raster.centers[i, j] + box.center
        place = replace(placement, position=(float(x), float(y), box.floor))
        (found if hold is None or hold.has_room(place, raster, box) else without_room).append(place)
        rank[np.linalg.norm(raster.centers - raster.centers[i, j], axis=-1) < APART] = 0.0
    return [*found, *without_room][:MOST]


def roomier_place(
    item: StandingObject,
    placement: Placement,
    inside: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]],
    waiting: Sequence[tuple[StandingObject, Placement]],
    box: Box,
) -> Placement:
    """Return the planned place, or the nearest one with more room if what is in the box left it too little.

    What was released, bowls above all, is not exactly where it was to be, and shapes are estimates: an object
    that is lowered with less room meets its neighbours.

    Args:
        item: the object to be placed.
        placement: its planned goal.
        inside: objects in the box, with T_world_stand.
        waiting: objects that are not yet there, with their goals.
        box: the box.
    """
    raster, reserved = _filled(box, inside), _reserved(BoxRaster(box, 0.0), box, waiting)
    shape = footprint(item).rotated(placement.yaws[0])
    planned = _cell(raster, np.array(placement.position[:2]) - box.center)

    def free(where: BoxRaster, gap: float) -> Bool[np.ndarray, "nx ny"]:
        return where.free_positions(Stencil.of(shape, gap, raster.cell))

    if free(raster, ENOUGH)[planned]:
        return placement
    away = np.linalg.norm(raster.centers - raster.centers[planned], axis=-1)
    possible = free(reserved, BETWEEN) & (away <= BESIDE)
    for gap in NARROW:
        places = free(raster, gap) & possible
        if places[planned]:
            return placement
        if places.any():
            nearest = np.unravel_index(np.argmin(np.where(places, away, np.inf)), away.shape)
            x, y = raster.centers[nearest] + box.center
            return replace(placement, position=(float(x), float(y), box.floor))
    return placement


def _filled(box: Box, objects: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]]) -> BoxRaster:
    """Return the raster of a box with the objects that are in it or near it, in any orientation."""
    raster = BoxRaster(box, 0.0)
    size = np.array(box.size[:2])
    for item, T_world_stand in objects:
        place = T_world_stand[:2, 3] - box.center
        if (np.abs(place) < size).all():
            parts = [part @ T_world_stand[:3, :3].T for part in split_handle(item.vertices, item.category)]
            outlines = tuple(part[ConvexHull(part[:, :2]).vertices, :2] for part in parts)
            shape = Footprint(outlines, max(float(part[:, 2].max()) for part in parts))
            raster.add(Stencil.of(shape, 0.0, raster.cell), _cell(raster, place), float(T_world_stand[2, 3]))
    return raster


def _reserved(raster: BoxRaster, box: Box, waiting: Sequence[tuple[StandingObject, Placement]]) -> BoxRaster:
    """Return the raster with the goals of objects occupied."""
    for item, goal in waiting:
        stencil = Stencil.of(footprint(item).rotated(goal.yaws[0]), 0.0, raster.cell)
        raster.add(stencil, _cell(raster, np.array(goal.position[:2]) - box.center))
    return raster


def _cell(raster: BoxRaster, place: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """Return the cell of a point relative to the centre of the box."""
    return int(np.abs(raster.x - place[0]).argmin()), int(np.abs(raster.y - place[1]).argmin())
