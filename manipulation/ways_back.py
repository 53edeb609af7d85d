"""Ways back to the table with an object in the hand that met something.

What met something may have turned between the pads. Where it was grasped among other objects, it is set down
where there is room for it however it is turned; else where it was grasped.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.motions import MotionPlanner, Path
from manipulation.robot import JointTrajectory
from manipulation.trajectories import concatenate, joint_move, line_postures
from manipulation.types import PickPlacePlan, Rejected
from perception.geometry import pose_from_yaw

_RISES = (0.18, 0.12, 0.08, 0.04)  # [m] above where an object met something, tried in order
DESCENT = 0.12  # [m] of the hand to where an object is set down
_ABOVE_TABLE = 0.01  # [m] of the base of an object that has not turned, as it is set down


def way_to_room(
    plan: PickPlacePlan,
    q: Float[np.ndarray, "n"],
    motions: MotionPlanner,
    spots: Sequence[tuple[float, float]],
    base: float,
    margins: Sequence[float | None],
) -> list[JointTrajectory]:
    """Return motions straight up, over one of several spots, and down to the table; none if there are none.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad].
        motions: motions in the world as it is known, with the object where it was grasped.
        spots: x and y of the TCP in [m], in descending order of preference.
        base: height of the object's lowest point where it was grasped, in [m].
        margins: clearances of the path in [m], in descending order.
    """
    kinematics, width = motions.kinematics, plan.grasp.held_width
    T_grasp = kinematics.forward(plan.lift.positions[0])
    with _carried(plan, motions):
        for x, y in spots:
            T_down = T_grasp.copy()
            T_down[:3, 3] = x, y, T_grasp[2, 3] - base + _ABOVE_TABLE
            turn = kinematics.bearing(T_down) - kinematics.bearing(T_grasp)
            T_down[:3, :3] = pose_from_yaw(turn, np.zeros(3))[:3, :3] @ T_grasp[:3, :3]
            T_above = T_down.copy()
            T_above[2, 3] += DESCENT
            above = kinematics.inverse(T_above, [plan.lift.positions[-1], q], name="a place to set it down")
            down = motions.free_line(above.q, [T_down], width) if above.converged else None
            if down is None or isinstance(down, Rejected):
                continue
            risen = _risen(q, above.q, width, motions, margins)
            if risen is not None:
                up, path = risen
                lines = [motions.time_line(line, "carried") for line in (up, down)]
                return [lines[0], motions.time_path(path), lines[1]]
    return []


def reversed_way(
    plan: PickPlacePlan, q: Float[np.ndarray, "n"], motions: MotionPlanner
) -> list[JointTrajectory]:
    """Return motions straight up, and from there back as the object was carried; none if that is impossible.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad]; there is no such way unless the object was being lowered.
        motions: motions in the world as it is known.
    """
    carried, lowered = (np.abs(way.positions - q).max(axis=1).min() for way in (plan.carry, plan.lowering))
    if carried <= lowered:
        return []
    q_above = plan.carry.positions[-1]
    up = line_postures(motions.kinematics, q, motions.kinematics.forward(q_above), motions.config)
    if up is None:
        return []
    back = concatenate([plan.carry.reversed(), plan.lift.reversed()])
    return [motions.time_line(up, "carried"), joint_move(up[-1], q_above, motions.limits), back]


def planned_way(
    plan: PickPlacePlan, q: Float[np.ndarray, "n"], motions: MotionPlanner, margins: Sequence[float | None]
) -> list[JointTrajectory]:
    """Return motions straight up, and from there along a free path; none if there is no such path.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad].
        motions: motions in the world as it is known.
        margins: clearances of the path in [m], in descending order.
    """
    with _carried(plan, motions):
        risen = _risen(q, plan.lift.positions[-1], plan.grasp.held_width, motions, margins)
    if risen is None:
        return []
    up, path = risen
    return [motions.time_line(up, "carried"), motions.time_path(path), plan.lift.reversed()]


@contextlib.contextmanager
def _carried(plan: PickPlacePlan, motions: MotionPlanner) -> Iterator[None]:
    """Plan with the object of a plan in the hand."""
    motions.world.carry(plan.name, np.linalg.inv(plan.grasp.T_stand_tcp))
    try:
        yield
    finally:
        motions.world.release()


def _risen(
    q: Float[np.ndarray, "n"],
    q_goal: Float[np.ndarray, "n"],
    width: float,
    motions: MotionPlanner,
    margins: Sequence[float | None],
) -> tuple[Float[np.ndarray, "k n"], Path] | None:
    """Return the postures of a line straight up and a free path from its end; None if there is none."""
    for height in _RISES:
        T_up = motions.kinematics.forward(q)
        T_up[2, 3] += height
        up = line_postures(motions.kinematics, q, T_up, motions.config)
        path = None if up is None else motions.free_path(up[-1], q_goal, width, margins)
        if up is not None and path is not None:
            return up, path
    return None
