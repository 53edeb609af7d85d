"""Ways back to where an object was grasped, with the object in the hand, after it met something."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.motions import MotionPlanner
from manipulation.robot import JointTrajectory
from manipulation.trajectories import concatenate, joint_move, line_postures
from manipulation.types import PickPlacePlan

_RISES = (0.18, 0.12, 0.08, 0.04)  # [m] above where an object met something, tried in order


def reversed_way(
    plan: PickPlacePlan, q: Float[np.ndarray, "n"], motions: MotionPlanner
) -> Iterator[JointTrajectory]:
    """Yield motions straight up, and from there back as the object was carried; none if that is impossible.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad]; there is no such way unless the object was being lowered.
        motions: motions in the world as it is known.
    """
    reached = int(np.abs(plan.transfer.positions - q).max(axis=1).argmin())
    if reached < len(plan.carry.positions):
        return
    q_above = plan.carry.positions[-1]
    up = line_postures(motions.kinematics, q, motions.kinematics.forward(q_above), motions.config)
    if up is not None:
        yield motions.time_line(up, "carried")
        yield joint_move(up[-1], q_above, motions.limits)
        yield concatenate([plan.carry.reversed(), plan.lift.reversed()])


def planned_way(
    plan: PickPlacePlan, q: Float[np.ndarray, "n"], motions: MotionPlanner, margins: Sequence[float | None]
) -> Iterator[JointTrajectory]:
    """Yield motions straight up, and from there along a free path; none if there is no such path.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad].
        motions: motions in the world as it is known.
        margins: clearances of the path in [m], in descending order.
    """
    grasp = plan.grasp
    motions.world.carry(plan.name, np.linalg.inv(grasp.T_stand_tcp))
    try:
        for height in _RISES:
            T_up = motions.kinematics.forward(q)
            T_up[2, 3] += height
            up = line_postures(motions.kinematics, q, T_up, motions.config)
            if up is None:
                continue
            path = motions.free_path(up[-1], plan.lift.positions[-1], grasp.held_width, margins)
            if path is not None:
                break
        else:
            return
    finally:
        motions.world.release()
    yield motions.time_line(up, "carried")
    yield motions.time_path(path)
    yield plan.lift.reversed()
