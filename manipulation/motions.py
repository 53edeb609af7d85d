"""Collision-free motions: straight TCP lines, and joint-space paths over waypoints where necessary."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from manipulation.collision import NO_CONTACT, AllowedContacts, CollisionWorld, Contact
from manipulation.kinematics import Kinematics
from manipulation.robot import JointTrajectory
from manipulation.trajectories import JointLimits, MotionConfig, joint_path, line_motion, line_postures
from manipulation.types import Rejected

OUT_OF_REACH = Rejected("out of reach", by_arm=True)

MIDDLE_RADIUS = 0.45  # [m]
MAX_SWING = float(np.deg2rad(45))  # of a level path
_SWING_STEP = 0.1  # [rad] between the postures at which the swing is looked at


class MotionPlanner:
    """Plans and times motions of one arm in one collision world.

    Attributes:
        kinematics, world: kinematics of the arm and the world that motions are checked in.
        limits: joint limits of all trajectories.
        config: speed limits.
        via_heights: TCP heights of waypoints in [m], tried in order.
        middle_radius: distance from the base of waypoints between start and goal in [m].
    """

    def __init__(
        self,
        kinematics: Kinematics,
        world: CollisionWorld,
        config: MotionConfig,
        via_heights: Sequence[float],
        middle_radius: float = MIDDLE_RADIUS,
    ) -> None:
        self.kinematics, self.world, self.config = kinematics, world, config
        self.limits = JointLimits.of(kinematics.arm, config)
        self.via_heights, self.middle_radius = tuple(via_heights), middle_radius

    def free_line(
        self,
        q: Float[np.ndarray, "n"],
        targets: Sequence[Float[np.ndarray, "4 4"]],
        width: float,
        allowed: AllowedContacts = NO_CONTACT,
    ) -> Float[np.ndarray, "k n"] | Rejected:
        """Return the postures [rad] of the first collision-free straight line from ``q`` to a target.

        Args:
            q: start posture in [rad].
            targets: TCP poses in descending order of preference.
            width: opening between the pads in [m].
            allowed: contacts that are no collisions.
        """
        contact = self.world.contact(q, width, allowed)
        if contact is not None:  # before any inverse kinematics
            return self.rejection(contact)
        rejected = OUT_OF_REACH
        for T_world_target in targets:
            postures = line_postures(self.kinematics, q, T_world_target, self.config)
            if postures is None:
                continue
            contact = self.world.path_contact(postures, width, allowed)
            if contact is None:
                return postures
            rejected = self.rejection(contact)
        return rejected

    def rejection(self, contact: Contact) -> Rejected:
        """Return why a candidate with a contact is discarded."""
        by_arm = not self.world.links.isdisjoint((contact.link, contact.obstacle))
        return Rejected(str(contact), contact.obstacle, by_arm)

    def free_path(
        self,
        q_start: Float[np.ndarray, "n"],
        q_goal: Float[np.ndarray, "n"],
        width: float,
        margins: Sequence[float | None] = (None,),
        level: bool = False,
    ) -> list[Float[np.ndarray, "n"]] | None:
        """Return waypoints of collision-free straight joint moves from start to goal, both included.

        A blocked direct move is replaced by moves over points above start, goal and between them.

        Args:
            q_start, q_goal: postures in [rad].
            width: opening between the pads in [m].
            margins: clearances of arm and carried object in [m]; the first that some path keeps is used. None
                is the clearance of the world's configuration.
            level: whether only paths are taken on which the hand does not swing, see ``swing``.

        Returns:
            The waypoints in [rad], or None if no candidate path is free.
        """
        for margin in margins:
            allowed = AllowedContacts(robot_margin=margin, carried_margin=margin)
            for path in self._candidate_paths(q_start, q_goal):
                if level and self.swing(path) > MAX_SWING:
                    continue
                if self.world.path_contact(np.stack(path), width, allowed) is None:
                    return path
        return None

    def swing(self, path: Sequence[Float[np.ndarray, "n"]]) -> float:
        """Return how far [rad] what was vertical in the hand's first pose tilts on a path, beyond its end.

        What is carried far from level is spilled, and slips in the hand.
        """
        up = self.kinematics.forward(path[0])[2, :3]  # the world's z in the frame of the hand
        tilts = []
        for begin, end in pairwise(path):
            count = 1 + int(np.abs(end - begin).max() / _SWING_STEP)
            for share in np.linspace(0.0, 1.0, count + 1):
                T = self.kinematics.forward(begin + share * (end - begin))
                tilts.append(float(np.arccos(np.clip(T[2, :3] @ up, -1.0, 1.0))))
        return max(tilts) - tilts[-1]

    def time_path(self, path: Sequence[Float[np.ndarray, "n"]]) -> JointTrajectory:
        """Return the trajectory of joint moves through waypoints [rad], at rest in each."""
        return joint_path(path, self.limits)

    def time_line(self, postures: Float[np.ndarray, "k n"]) -> JointTrajectory:
        """Return the trajectory along the postures [rad] of a straight TCP line."""
        start, end = (self.kinematics.forward(q)[:3, 3] for q in (postures[0], postures[-1]))
        return line_motion(postures, float(np.linalg.norm(end - start)), self.limits, self.config)

    def _candidate_paths(self, q_start: np.ndarray, q_goal: np.ndarray) -> Iterator[list[np.ndarray]]:
        yield [q_start, q_goal]
        for waypoints in self._waypoints(q_start, q_goal):
            yield [q_start, *waypoints, q_goal]

    def _waypoints(self, q_start: np.ndarray, q_goal: np.ndarray) -> Iterator[list[np.ndarray]]:
        """Yield candidates: above the start, the goal, the middle, and above both ends, at each height."""
        T_start, T_goal = self.kinematics.forward(q_start), self.kinematics.forward(q_goal)
        azimuth = 0.5 * sum(self.kinematics.bearing(T) for T in (T_start, T_goal))
        middle = self.kinematics.base[:2] + self.middle_radius * np.array([np.cos(azimuth), np.sin(azimuth)])
        for height in self.via_heights:
            over_start = self._above(T_start, T_start[:2, 3], height, q_start)
            over_goal = self._above(T_goal, T_goal[:2, 3], height, q_goal)
            over_middle = self._above(T_goal, middle, height, q_goal)
            for candidate in ([over_start], [over_goal], [over_middle], [over_start, over_goal]):
                reached = [q for q in candidate if q is not None]
                if len(reached) == len(candidate):
                    yield reached

    def _above(
        self, T_world_tcp: np.ndarray, xy: np.ndarray, height: float, q_seed: np.ndarray
    ) -> np.ndarray | None:
        """Return the posture with the TCP above a point and the orientation of a pose; None if unreachable.

        The TCP is never lower than that of the pose.
        """
        T_above = T_world_tcp.copy()
        T_above[:2, 3], T_above[2, 3] = xy, max(height, T_world_tcp[2, 3])
        result = self.kinematics.inverse(T_above, [q_seed], name="a waypoint")
        return result.q if result.converged else None
