"""Free places on the table, where objects are turned or set aside."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

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
# Distance of a spot from the middle, and height of an object there, up to which half of the images of a scan
# show all of the object, in half diagonals of the area: a cone.
_VIEW, _VIEW_HEIGHT = 1.15, 1.7
_CLEARANCES = (0.10, 0.06, 0.03)  # [m] between outlines, from most room to least
_ROOMS = (1.3, 1.0, 0.7, 0.4)  # shares of an object's reach from the TCP that are free around it
_MOST = 4  # roomy spots

Area = tuple[tuple[float, float], tuple[float, float]]
Outline = Float[np.ndarray, "_k 2"]  # convex, in the world frame in [m]


def outline_of(item: StandingObject, T_world_stand: Float[np.ndarray, "4 4"]) -> Outline:
    """Return the convex outline of an object's top view in any orientation."""
    return _hull((item.vertices @ T_world_stand[:3, :3].T + T_world_stand[:3, 3])[:, :2])


def outline_of_thing(obstacle: PerceivedObstacle) -> Outline:
    """Return the convex outline of the top view of a thing of no class."""
    return _hull(np.concatenate(obstacle.pieces)[:, :2])


def outlines_of_others(
    items: Mapping[str, StandingObject],
    poses: Mapping[str, Float[np.ndarray, "4 4"]],
    things: Sequence[PerceivedObstacle],
    but: Collection[str],
) -> list[Outline]:
    """Return the outlines of the top views of all objects but some, at T_world_stand, and of things."""
    objects = [outline_of(items[name], T) for name, T in poses.items() if name not in but]
    return objects + [outline_of_thing(thing) for thing in things]


def free_spots(
    radius: float, taken: Sequence[Outline], area: Area = FREE_AREA, height: float = 0.0
) -> Iterator[tuple[float, float]]:
    """Yield spots in an area where a circle [m] is clear of outlines.

    Those with room for the hand around them come first, then those near the middle. A spot far from the base
    counts as one with less room: a hand that is not vertical hardly reaches what lies there. So does one
    where few images show the top of an object: it is looked at again if it cannot be grasped.

    Args:
        radius: radius of the circle in [m].
        taken: outlines of the top views of all other things.
        area: ranges of x and y of the spots, in [m].
        height: height of the object there in [m].
    """
    (x0, x1), (y0, y1) = area
    spots = _grid(area)
    around = Footprint(tuple(taken), 0.0)
    crowding = np.sum([around.covers(spots, radius + clearance) for clearance in _CLEARANCES], axis=0)
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    from_middle = np.linalg.norm(spots - middle, axis=1)
    is_far = np.linalg.norm(spots, axis=1) > _FAR * np.linalg.norm(middle)
    size = float(np.hypot(x1 - x0, y1 - y0)) / 2
    is_cut = from_middle > _VIEW * (size - height / _VIEW_HEIGHT)
    found = np.zeros((0, 2))
    for index in np.lexsort((from_middle, crowding + is_far + is_cut)):
        is_apart = (np.linalg.norm(found - spots[index], axis=1) >= _APART).all()
        if crowding[index] < len(_CLEARANCES) and is_apart:
            found = np.vstack([found, spots[index]])
            yield float(spots[index][0]), float(spots[index][1])


def roomy_spots(
    place: tuple[float, float], reach: float, taken: Sequence[Outline], area: Area = FREE_AREA
) -> list[tuple[float, float]]:
    """Return some spots in an area with more room around them than a place has, the nearest one first.

    Args:
        place: x and y in [m].
        reach: largest distance in [m] of a point of an object from the TCP, about which it may turn.
        taken: outlines of the top views of all other things.
        area: ranges of x and y of the spots, in [m].
    """
    around, spots, here = Footprint(tuple(taken), 0.0), _grid(area), np.array(place)
    for room in _ROOMS:
        if not around.covers(here, room * reach):
            return []
        free = spots[~around.covers(spots, room * reach)]
        if len(free):
            by_distance = free[np.argsort(np.linalg.norm(free - here, axis=1))]
            return [(float(x), float(y)) for x, y in by_distance[:: 1 + len(free) // _MOST]]
    return []


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
    for x, y in free_spots(radius, taken, area, float(high[2] - low[2])):
        yield Placement(item.name, (x, y, 0.0), yaws, T_goal_stand=T_goal)


def _grid(area: Area) -> Float[np.ndarray, "n 2"]:
    """Return the spots of an area that are examined."""
    (x0, x1), (y0, y1) = area
    grid = np.stack(np.meshgrid(np.arange(x0, x1, _SPACING), np.arange(y0, y1, _SPACING)), axis=-1)
    return grid.reshape(-1, 2)


def _hull(points: Float[np.ndarray, "n 2"]) -> Outline:
    return points[ConvexHull(points).vertices]
