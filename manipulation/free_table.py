"""Free places on the table, where objects are turned or set aside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from manipulation.footprints import Footprint
from manipulation.lying_grasps import lies
from manipulation.types import Placement, StandingObject
from perception.obstacles.obstacle import PerceivedObstacle

FREE_AREA = ((0.30, 0.68), (-0.52, 0.02))  # [m] ranges of x and y
N_YAWS = 12  # of a goal on free table
_SPACING = 0.03  # [m] between the spots examined
_APART = 0.07  # [m] between the spots that are found
_FAR = 1.2  # distance of a spot from the base, relative to that of the middle, from which on it is far
_CLEARANCES = (0.10, 0.06, 0.03)  # [m] between outlines, from most room to least

Area = tuple[tuple[float, float], tuple[float, float]]
Outline = Float[np.ndarray, "_k 2"]  # convex, in the world frame in [m]


def outline_of(item: StandingObject, T_world_stand: Float[np.ndarray, "4 4"]) -> Outline:
    """Return the convex outline of an object's top view in any orientation."""
    return _hull((item.vertices @ T_world_stand[:3, :3].T + T_world_stand[:3, 3])[:, :2])


def outline_of_thing(obstacle: PerceivedObstacle) -> Outline:
    """Return the convex outline of the top view of a thing of no class."""
    return _hull(np.concatenate(obstacle.pieces)[:, :2])


def free_spots(
    radius: float, taken: Sequence[Outline], area: Area = FREE_AREA
) -> Iterator[tuple[float, float]]:
    """Yield spots in an area where a circle [m] is clear of outlines.

    Those with room for the hand around them come first, then those near the middle. A spot far from the base
    counts as one with less room: a hand that is not vertical hardly reaches what lies there.
    """
    (x0, x1), (y0, y1) = area
    grid = np.stack(np.meshgrid(np.arange(x0, x1, _SPACING), np.arange(y0, y1, _SPACING)), axis=-1)
    spots = grid.reshape(-1, 2)
    around = Footprint(tuple(taken), 0.0)
    crowding = np.sum([around.covers(spots, radius + clearance) for clearance in _CLEARANCES], axis=0)
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    from_middle = np.linalg.norm(spots - middle, axis=1)
    is_far = np.linalg.norm(spots, axis=1) > _FAR * np.linalg.norm(middle)
    found = np.zeros((0, 2))
    for index in np.lexsort((from_middle, crowding + is_far)):
        is_apart = (np.linalg.norm(found - spots[index], axis=1) >= _APART).all()
        if crowding[index] < len(_CLEARANCES) and is_apart:
            found = np.vstack([found, spots[index]])
            yield float(spots[index][0]), float(spots[index][1])


def goals_aside(
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    taken: Sequence[Outline],
    area: Area = FREE_AREA,
) -> Iterator[Placement]:
    """Yield goals on free table at which an object stands, or lies as it does but for the yaw.

    Roomy ones come first.

    Args:
        item: the object.
        T_world_stand: its pose.
        taken: outlines of the top views of all other things.
        area: ranges of x and y of the spots, in [m].
    """
    T_goal = np.eye(4)
    if lies(T_world_stand):
        T_goal[:3, :3] = T_world_stand[:3, :3]
    turned = item.vertices @ T_goal[:3, :3].T
    low, high = turned.min(axis=0), turned.max(axis=0)
    T_goal[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    radius = float(np.linalg.norm((turned + T_goal[:3, 3])[:, :2], axis=1).max())
    yaws = tuple(2 * np.pi * np.arange(N_YAWS) / N_YAWS)
    for x, y in free_spots(radius, taken, area):
        yield Placement(item.name, (x, y, 0.0), yaws, T_goal_stand=T_goal)


def _hull(points: Float[np.ndarray, "n 2"]) -> Outline:
    return points[ConvexHull(points).vertices]
