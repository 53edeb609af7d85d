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
    """Yield motions straight up, and from there back along the transfer; none if that is impossible.

    Args:
        plan: the plan that was under way.
        q: present posture in [rad].
        motions: motions in the world as it is known.
    """
    transfer = plan.transfer
    reached = int(np.abs(transfer.positions - q).max(axis=1).argmin())
    is_at_rest = np.abs(transfer.velocities[: reached + 1]).max(axis=1) < 1e-6
    above = int(np.flatnonzero(is_at_rest).max(initial=0))
    T_above = motions.kinematics.forward(transfer.positions[above])
    up = line_postures(motions.kinematics, q, T_above, motions.config) if above > 0 else None
    if up is not None:
        yield motions.time_line(up)
        yield joint_move(up[-1], transfer.positions[above], motions.limits)
        yield concatenate([transfer.until(above).reversed(), plan.lift.reversed()])


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
    yield motions.time_line(up)
    yield motions.time_path(path)
    yield plan.lift.reversed()
