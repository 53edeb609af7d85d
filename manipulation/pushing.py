"""An object that no hand fits beside is pushed along the table, until a grasp of it is free.

The closed hand pushes through the middle of the object's top view, where it does not turn. A round object on
its side is pushed about along its axis, for across it it rolls; another one, and one that stands, near its
base, in any direction. What it touches it slides along.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.collision import AllowedContacts
from manipulation.free_table import outline_of
from manipulation.grasp_config import tcp_pose
from manipulation.hand_collision import surface_points
from manipulation.lifting import in_contact
from manipulation.lying_grasps import lies
from manipulation.motions import MotionPlanner
from manipulation.obstacles import TABLE
from manipulation.robot import GripperGeometry
from manipulation.trajectories import JointTrajectory
from manipulation.types import Rejected, StandingObject
from perception.types import TriangleMesh

DISTANCES = (0.03, 0.05, 0.08, 0.11)  # [m], tried in order
_GAP = 0.010  # [m] between the closed hand and the object, where the push begins
_TIPS = 0.008  # [m] height of the fingertips
_HIGHER = 0.4  # the same for an object on its side, relative to its height, where the palm meets things
_FINGERS = 0.05  # [m] height over the tips up to which the fingers may touch the object
_TILTS = np.deg2rad([0.0, 20.0, 40.0])  # of the hand, with the fingertips ahead
_RAISED = (0.12, 0.06)  # [m] above the beginning, where the hand comes from
_BACK, _UP = 0.03, 0.08  # [m] by which the hand leaves the object
_N_DIRECTIONS = 8  # in which an object is pushed that cannot roll
_OBLIQUE = np.deg2rad([0.0, 20.0, -20.0])  # to the axis of an object on its side
_DOWN = np.array([0.0, 0.0, -1.0])

Pose = Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class Push:
    """Motions of the closed hand that push an object along a straight line.

    Attributes:
        name: the object.
        transit: to above the beginning.
        approach, push, retreat: down to it, along the line, and away.
        T_world_stand: expected pose of the object's stand frame afterwards.
    """

    name: str
    transit: JointTrajectory
    approach: JointTrajectory
    push: JointTrajectory
    retreat: JointTrajectory
    T_world_stand: Pose


def plan_push(
    motions: MotionPlanner,
    item: StandingObject,
    q_start: Float[np.ndarray, "n"],
    helps: Callable[[Pose], bool],
) -> Push | None:
    """Return the shortest push after which an object can be grasped; None if there is none, or it can be now.

    Args:
        motions: plans motions of the closed hand, in a world with the object.
        item: the object.
        q_start: present posture in [rad].
        helps: whether the object could be grasped at a pose.
    """
    T = motions.world.pose(item.name)
    if helps(T):
        return None
    gripper, directions = motions.kinematics.arm.gripper, list(_directions(item, T))

    @functools.cache
    def starts(number: int) -> list[Pose]:
        """Return where a push in a direction may begin: what meets something when short does when long."""
        poses, step = _starts(item, T, directions[number], gripper), DISTANCES[0] * directions[number]
        return [pose for pose in poses if _stroke(motions, item, pose, step) is not None]

    for distance in DISTANCES:
        for number, direction in enumerate(directions):
            # Whether a push helps takes much longer to tell than whether there is one.
            if not starts(number) or not helps(_moved(T, distance * direction)):
                continue
            pushes = (_push(motions, item, pose, distance * direction, q_start) for pose in starts(number))
            push = next((push for push in pushes if push is not None), None)
            if push is not None:
                return push
    return None


def _directions(item: StandingObject, T: Pose) -> Iterator[Float[np.ndarray, "3"]]:
    """Yield horizontal unit vectors: of what can roll about along its axis, from its base first."""
    azimuths = 2 * np.pi * np.arange(_N_DIRECTIONS) / _N_DIRECTIONS
    if lies(T) and item.is_round:
        along = np.arctan2(T[1, 2], T[0, 2])
        azimuths = np.concatenate([along + _OBLIQUE, along + np.pi + _OBLIQUE])
    for azimuth in azimuths:
        yield np.array([np.cos(azimuth), np.sin(azimuth), 0.0])


def _starts(
    item: StandingObject, T: Pose, direction: Float[np.ndarray, "3"], gripper: GripperGeometry
) -> Iterator[Pose]:
    """Yield TCP poses of the closed hand behind an object: with its broad side to it, or its narrow one.

    The palm is long: across the push it may meet what is beside the object, along it the object itself.
    """
    outline = outline_of(item, T)
    middle = np.array([*(outline.min(axis=0) + outline.max(axis=0)) / 2, 0.0])
    points = surface_points(TriangleMesh(item.vertices, item.faces)) @ T[:3, :3].T + T[:3, 3]
    base, top = float(points[:, 2].min()), float(points[:, 2].max())
    aside = np.cross(direction, (0.0, 0.0, 1.0))
    broad, narrow = gripper.finger_reach + 0.5 * gripper.min_width, gripper.finger_half_width
    heights = (_TIPS, _HIGHER * (top - base)) if lies(T) else (_TIPS,)
    for low, (closing, half_width, half_depth) in itertools.product(
        heights, ((aside, broad, narrow), (direction, narrow, broad))
    ):
        level = points[:, 2] - base
        met = (np.abs((points - middle) @ aside) < half_width) & (low < level) & (level < low + _FINGERS)
        if not met.any():
            continue
        behind = float(((points[met] - middle) @ direction).min()) - _GAP - half_depth
        for tilt in _TILTS if closing is aside else (0.0,):
            approach = np.cos(tilt) * _DOWN + np.sin(tilt) * direction
            height = base + low + half_depth * np.sin(tilt)
            tips = middle + behind * direction + np.array([0.0, 0.0, height])
            for sign in (1.0, -1.0):
                yield tcp_pose(tips - gripper.tip * approach, approach, sign * closing)


def _push(
    motions: MotionPlanner, item: StandingObject, T: Pose, step: Float[np.ndarray, "3"], q_start: np.ndarray
) -> Push | None:
    """Return the motions of a push by ``step`` [m] from a TCP pose; None if they are not free."""
    stroke = _stroke(motions, item, T, step)
    if stroke is None:
        return None
    down, push = stroke
    name, width = item.name, motions.kinematics.arm.gripper.min_width
    direction = step / np.linalg.norm(step)
    touch = AllowedContacts(touch=frozenset({name}))
    T_leave = _moved(T, step + (_GAP - _BACK) * direction - _UP * _DOWN)
    leave = motions.free_line(push[-1], [T_leave], width, touch)
    if isinstance(leave, Rejected):
        return None
    path = motions.free_path(q_start, down[-1], width)
    if path is None:
        return None
    T_after = _moved(motions.world.pose(name), step)
    time_line = motions.time_line
    pushed = time_line(push, "pushed")
    return Push(name, motions.time_path(path), time_line(down[::-1]), pushed, time_line(leave), T_after)


def _stroke(
    motions: MotionPlanner, item: StandingObject, T: Pose, step: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "_j n"], Float[np.ndarray, "_k n"]] | None:
    """Return the postures [rad] up from a TCP pose, and from it along a push; None if they are not free."""
    name, width = item.name, motions.kinematics.arm.gripper.min_width
    found = motions.kinematics.inverse(T, motions.kinematics.seeds_toward(T, 2), name=name)
    if not found.converged:
        return None
    direction = step / np.linalg.norm(step)
    down = motions.free_line(found.q, [_moved(T, height * -_DOWN) for height in _RAISED], width)
    if isinstance(down, Rejected):
        return None
    touch = AllowedContacts(touch=frozenset({name}))
    T_end = _moved(T, step + _GAP * direction)
    push = motions.free_line(found.q, [T_end], width, touch)
    if isinstance(push, Rejected) or not _slides(motions, name, push, step):
        return None
    return down, push


def _slides(
    motions: MotionPlanner, name: str, push: Float[np.ndarray, "k n"], step: Float[np.ndarray, "3"]
) -> bool:
    """Return whether an object that the hand takes along meets nothing but what it touches already."""
    world, width = motions.world, motions.kinematics.arm.gripper.min_width
    T_end = motions.kinematics.forward(push[-1])
    remaining = np.array([np.linalg.norm((motions.kinematics.forward(q) - T_end)[:3, 3]) for q in push])
    moving = push[remaining <= np.linalg.norm(step) + 1e-6]
    world.carry(name, np.linalg.inv(_moved(T_end, -step)) @ world.pose(name))
    try:
        touches = AllowedContacts(touch_carried=frozenset({TABLE.name}), carried_margin=0.0)
        touches = in_contact(world, name, moving[0], width, touches) or touches
        return world.path_contact(moving, width, touches) is None
    finally:
        world.release()


def _moved(T: Pose, step: Float[np.ndarray, "3"]) -> Pose:
    moved = T.copy()
    moved[:3, 3] += step
    return moved
