"""Timing of the joint moves of a plan: corners are cut where that is free, carried objects stay in hand."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from manipulation.blending import blended, corner_postures
from manipulation.carrying import MAX_TORQUE, carrying_moves, inertial_torque
from manipulation.collision import AllowedContacts
from manipulation.motions import MotionPlanner
from manipulation.robot import JointTrajectory
from manipulation.trajectories import joint_move
from manipulation.types import Grasp, StandingObject
from perception.geometry import invert, transform_points

CORNER_MARGIN = 0.012  # [m] clearance of the arm and of what is carried with which a corner is cut


class PlanTiming:
    """Times the motions of plans in one collision world.

    Args:
        motions: planner of the motions.
    """

    def __init__(self, motions: MotionPlanner) -> None:
        self._motions = motions

    def transit(self, path: Sequence[Float[np.ndarray, "n"]], width: float) -> JointTrajectory:
        """Return the motion along a path [rad] of the empty hand, whose pads are ``width`` [m] apart."""
        limits = self._motions.limits
        moves = [joint_move(begin, end, limits) for begin, end in pairwise(path)]
        return blended(moves, limits, lambda around: self._is_free(around, width))

    def carry(
        self, item: StandingObject, grasp: Grasp, path: Sequence[Float[np.ndarray, "n"]]
    ) -> JointTrajectory:
        """Return the motion of a carried object along a path [rad].

        Args:
            item: the object; it is in the hand meanwhile, and the hand of the world is empty afterwards.
            grasp: how it is held.
            path: waypoints of joint moves.
        """
        motions = self._motions
        limits, kinematics = motions.limits, motions.kinematics
        T_tcp_stand = invert(grasp.T_stand_tcp)
        centre = 0.5 * (item.vertices.min(axis=0) + item.vertices.max(axis=0))
        centre_in_hand = transform_points(T_tcp_stand, centre[None])[0]

        def allows(around: JointTrajectory) -> bool:
            is_steady = inertial_torque(kinematics, around, centre_in_hand) <= MAX_TORQUE
            return is_steady and self._is_free(around, grasp.held_width)

        motions.world.carry(item.name, T_tcp_stand)
        try:
            return blended(carrying_moves(kinematics, path, centre_in_hand, limits), limits, allows)
        finally:
            motions.world.release()

    def _is_free(self, around: JointTrajectory, width: float) -> bool:
        """Return whether a corner may be cut."""
        clear = AllowedContacts(robot_margin=CORNER_MARGIN, carried_margin=CORNER_MARGIN)
        return self._motions.world.path_contact(corner_postures(around), width, clear) is None
