"""Turning objects that do not stand: grasps with which they can be turned, and goals on free table.

An object on its side is set upright, one that is upside down is first laid on its side.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from manipulation.antipodal_grasps import antipodal_grasps
from manipulation.free_table import FREE_AREA, N_YAWS, Area, Outline, free_spots
from manipulation.grasp_config import GraspConfig
from manipulation.lying_grasps import is_upside_down, lying_grasps
from manipulation.types import GraspSet, Placement, StandingObject
from perception.geometry import pose_from_yaw

_SHORTEST = 0.008  # [m] between the lines of contact of an object that lies still
_BALANCE = 0.02  # least share of that distance between the centre and its ends
_N_SIDES = 2  # on which an object that is upside down is laid
_ROLLS = 2 * np.pi * np.arange(6) / 6  # of a round object
_UP = np.array([0.0, 0.0, 1.0])


def reorienting_grasps(
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    config: GraspConfig = GraspConfig(),
    surroundings: Float[np.ndarray, "n 3"] = np.zeros((0, 3)),
) -> GraspSet:
    """Return grasps with which an object that does not stand can be turned by 90 degrees.

    Of one on its side: across its axis from above, then antipodal ones with which it can be set upright; of
    one upside down: antipodal ones with which it can be laid on its side.

    Args:
        item: the object.
        T_world_stand: its pose.
        config: settings of grasp generation.
        surroundings: points of other things, in the stand frame in [m], that antipodal grasps are to avoid.
    """
    up = T_world_stand[:3, :3].T @ _UP
    if not is_upside_down(T_world_stand):
        across = lying_grasps(item, T_world_stand, config)
        between = antipodal_grasps(item, (up, _UP), config, surroundings)
        return GraspSet(across.grasps + between.grasps, across.rejected + between.rejected)
    sides = lying_sides(item)[:_N_SIDES]
    if not sides:
        return GraspSet((), Counter({"for the side, on which it does not lie still": 1}))
    if item.is_round:  # the roll at the goal follows the grasp
        sides = list(np.stack([np.cos(_ROLLS), np.sin(_ROLLS), np.zeros_like(_ROLLS)], axis=1))
    return antipodal_grasps(item, (up,), config, surroundings, sides)


def rolled(
    item: StandingObject, T_goal_stand: Float[np.ndarray, "4 4"], away: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a round object on its side, rolled such that a direction of it points upwards.

    Args:
        item: the object; others than round ones are not rolled.
        T_goal_stand: its pose.
        away: the direction in its stand frame.
    """
    if not item.is_round or abs(T_goal_stand[2, 2]) > 0.5:
        return T_goal_stand
    up = T_goal_stand[2, :2]
    angle = np.arctan2(away[1], away[0]) - np.arctan2(up[1], up[0])
    return T_goal_stand @ pose_from_yaw(-float(angle), np.zeros(3))


def lying_sides(item: StandingObject) -> list[Float[np.ndarray, "3"]]:
    """Return the vertical in the stand frame in each pose in which an object lies still on its side.

    It rests on an edge of the convex hull of its top view, with the centre of the hull's area above that edge
    and not near its ends. A round object lies on any side: +x alone is returned.
    """
    if item.is_round:
        return [np.array([1.0, 0.0, 0.0])]
    outline = item.vertices[:, :2]
    hull = ConvexHull(outline)
    corners = outline[hull.vertices]
    after = np.roll(corners, -1, axis=0)
    cross = corners[:, 0] * after[:, 1] - after[:, 0] * corners[:, 1]
    center = ((corners + after) * cross[:, None]).sum(axis=0) / (3 * cross.sum())
    length = np.linalg.norm(after - corners, axis=1)
    along = (after - corners) / np.maximum(length, 1e-9)[:, None]
    share = ((center - corners) * along).sum(axis=1) / np.maximum(length, 1e-9)
    stable = (length > _SHORTEST) & (share > _BALANCE) & (share < 1 - _BALANCE)
    order = [k for k in np.argsort(-length, kind="stable") if stable[k]]
    return [
        np.array([-along[k, 1], along[k, 0], 0.0]) for k in order
    ]  # inwards: the hull is counterclockwise


def turning_goals(
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    taken: Sequence[Outline],
    area: Area = FREE_AREA,
) -> Iterator[Placement]:
    """Yield goals on free table, roomy ones first: upright, or on its side.

    Args:
        item: the object.
        T_world_stand: its pose.
        taken: outlines of the top views of all other things.
        area: ranges of x and y of the spots, in [m].
    """
    poses: list[Float[np.ndarray, "4 4"] | None] = [None]
    if is_upside_down(T_world_stand):
        poses = [_laid(item, side) for side in lying_sides(item)[:_N_SIDES]]
    radius, height = _extent(item, poses[0]) if poses else (0.0, 0.0)
    for spot in free_spots(radius, taken, area, height):
        yaws = tuple(2 * np.pi * k / N_YAWS for k in range(N_YAWS))
        for T_goal_stand in poses:
            yield Placement(item.name, (*spot, 0.0), yaws, T_goal_stand=T_goal_stand)


def _laid(item: StandingObject, up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the stand frame's pose with ``up`` vertical, the object over the origin and on the plane."""
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(_UP, up), _UP, up])  # rows: images of the axes of the goal frame
    turned = item.vertices @ T[:3, :3].T
    low, high = turned.min(axis=0), turned.max(axis=0)
    T[:3, 3] = -(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2]
    return T


def _extent(item: StandingObject, T_goal_stand: Float[np.ndarray, "4 4"] | None) -> tuple[float, float]:
    """Return the radius [m] of the circle about a goal's origin around the top view, and the height [m]."""
    points = item.vertices
    if T_goal_stand is not None:
        points = points @ T_goal_stand[:3, :3].T + T_goal_stand[:3, 3]
    return float(np.linalg.norm(points[:, :2], axis=1).max()), float(np.ptp(points[:, 2]))
