"""Timing of motions with a carried object: so slow that its inertia does not turn it between the pads.

The pads hold an object of mass m at a distance r from its centre. An acceleration a of the centre exerts the
torque m r x a on the pads, which friction has to bear in addition to that of gravity. Slowing a motion down
by a factor s divides a, and so that torque, by s^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from manipulation.kinematics import Kinematics
from manipulation.robot import JointTrajectory
from manipulation.trajectories import JointLimits, joint_move

MAX_TORQUE = 0.35  # [N m / kg] largest |r x a|; a bottle held by its neck slipped out at 0.73
_SAMPLES = 40  # of a move at which the acceleration is looked at


def carrying_moves(
    kinematics: Kinematics,
    waypoints: Sequence[Float[np.ndarray, "n"]],
    centre: Float[np.ndarray, "3"],
    limits: JointLimits,
    max_torque: float = MAX_TORQUE,
) -> list[JointTrajectory]:
    """Return joint moves through waypoints [rad], at rest in each, as fast as the grasp of the object allows.

    Args:
        kinematics: Kinematics of the arm.
        waypoints: Postures in [rad], at least two.
        centre: Centre of the carried object in the frame of the TCP in [m].
        limits: Joint limits.
        max_torque: Largest torque about the TCP of the object's inertia per mass, in [N m / kg].
    """
    moves = []
    for begin, end in pairwise(waypoints):
        move = joint_move(begin, end, limits)
        slowdown = np.sqrt(max(1.0, inertial_torque(kinematics, move, centre) / max_torque))
        moves.append(move if slowdown == 1.0 else joint_move(begin, end, slower(limits, float(slowdown))))
    return moves


def inertial_torque(kinematics: Kinematics, motion: JointTrajectory, centre: Float[np.ndarray, "3"]) -> float:
    """Return the largest torque about the TCP of a carried object's inertia per mass, in [N m / kg].

    The object is taken as a point mass at its centre, which is given in the frame of the TCP in [m].
    """
    step = max(1, len(motion.positions) // _SAMPLES)
    poses = [kinematics.forward(q) for q in motion.positions[::step]]
    if len(poses) < 3:
        return 0.0
    levers = np.stack([T[:3, :3] @ centre for T in poses])
    centres = levers + np.stack([T[:3, 3] for T in poses])
    accelerations = np.diff(centres, 2, axis=0) / (step * motion.period) ** 2
    return float(np.linalg.norm(np.cross(levers[1:-1], accelerations), axis=1).max())


def slower(limits: JointLimits, factor: float) -> JointLimits:
    """Return the limits with which the same path takes ``factor`` times as long."""
    return replace(
        limits,
        velocity=limits.velocity / factor,
        acceleration=limits.acceleration / factor**2,
        jerk=limits.jerk / factor**3,
    )
