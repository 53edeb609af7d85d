"""Collision-free pieces of motion: straight TCP lines, and joint moves over way points where need be."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.collision import NOTHING, Allowance, CollisionWorld
from manipulation.kinematics import Kinematics
from manipulation.robot import JointTrajectory
from manipulation.trajectories import JointLimits, MotionConfig, joint_path, line_motion, line_postures

_MIDDLE_RADIUS = 0.45  # [m] from the base, where way points between start and goal lie


class Motions:
    """Finds and times motions of one arm in one collision world.

    Attributes:
        kinematics, world: of the arm.
        limits: that every motion keeps.
        config: speeds.
        via_heights: TCP heights of way points in [m], tried in order.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        world: CollisionWorld,
        config: MotionConfig,
        via_heights: Sequence[float],
    ) -> None:
        self.kinematics, self.world, self.config = kinematics, world, config
        self.limits = JointLimits.of(kinematics.arm, config)
        self.via_heights = tuple(via_heights)

    def free_line(
        self,
        q: Float[np.ndarray, "n"],
        targets: Sequence[Float[np.ndarray, "4 4"]],
        width: float,
        allow: Allowance = NOTHING,
    ) -> Float[np.ndarray, "k n"] | str:
        """Postures of the first free straight line from ``q`` to a TCP target, or why there is none.

        Args:
            q: start posture in [rad].
            targets: TCP poses, the preferred one first.
            width: between the pads in [m].
            allow: what hand and carried object may touch.
        """
        reason = "out of reach"
        for T_world_target in targets:
            postures = line_postures(self.kinematics, q, T_world_target, self.config)
            if postures is None:
                continue
            contact = self.world.path_contact(postures, width, allow)
            if contact is None:
                return postures
            reason = contact
        return reason

    def free_way(
        self,
        q_start: Float[np.ndarray, "n"],
        q_goal: Float[np.ndarray, "n"],
        width: float,
        margins: Sequence[float | None] = (None,),
    ) -> list[Float[np.ndarray, "n"]] | None:
        """Way points of free straight joint moves from start to goal, both included; None if none is found.

        Where the direct move is blocked, it is led over points high above start, goal and between them.

        Args:
            q_start, q_goal: postures in [rad].
            width: between the pads in [m].
            margins: what arm and carried object should keep, in [m], the first that some way allows; None is
                the world's own.
        """
        for margin in margins:
            allow = Allowance(robot_margin=margin, carried_margin=margin)
            for way in self._ways(q_start, q_goal):
                if self.world.path_contact(np.stack(way), width, allow) is None:
                    return way
        return None

    def timed_way(self, way: Sequence[Float[np.ndarray, "n"]]) -> JointTrajectory:
        """Joint moves through way points, at rest in each."""
        return joint_path(way, self.limits)

    def timed_line(self, postures: Float[np.ndarray, "k n"]) -> JointTrajectory:
        """Motion along the postures of a straight TCP line."""
        start, end = (self.kinematics.forward(q)[:3, 3] for q in (postures[0], postures[-1]))
        return line_motion(postures, float(np.linalg.norm(end - start)), self.limits, self.config)

    def _ways(self, q_start: np.ndarray, q_goal: np.ndarray) -> Iterator[list[np.ndarray]]:
        yield [q_start, q_goal]
        for via in self._vias(q_start, q_goal):
            yield [q_start, *via, q_goal]

    def _vias(self, q_start: np.ndarray, q_goal: np.ndarray) -> Iterator[list[np.ndarray]]:
        """Way points to try: above the start, the goal, the middle, and above both ends, ever higher."""
        T_start, T_goal = self.kinematics.forward(q_start), self.kinematics.forward(q_goal)
        azimuth = 0.5 * sum(np.arctan2(T[1, 3], T[0, 3]) for T in (T_start, T_goal))
        middle = _MIDDLE_RADIUS * np.array([np.cos(azimuth), np.sin(azimuth)])
        for height in self.via_heights:
            over_start = self._above(T_start, T_start[:2, 3], height, q_start)
            over_goal = self._above(T_goal, T_goal[:2, 3], height, q_goal)
            over_middle = self._above(T_goal, middle, height, q_goal)
            for via in ([over_start], [over_goal], [over_middle], [over_start, over_goal]):
                reached = [q for q in via if q is not None]
                if len(reached) == len(via):
                    yield reached

    def _above(
        self, T_world_tcp: np.ndarray, xy: np.ndarray, height: float, q_seed: np.ndarray
    ) -> np.ndarray | None:
        """Posture with the TCP above a point, the hand turned as in the given pose; None if out of reach."""
        T_above = T_world_tcp.copy()
        T_above[:2, 3], T_above[2, 3] = xy, max(height, T_world_tcp[2, 3])
        result = self.kinematics.inverse(T_above, [q_seed], name="a way point")
        return result.q if result.converged else None
