"""Collision-free motions: straight TCP lines, and joint-space paths over waypoints where necessary."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from manipulation.collision import NO_CONTACT, AllowedContacts, CollisionWorld, Contact
from manipulation.kinematics import Kinematics
from manipulation.path_search import search_path
from manipulation.robot import JointTrajectory
from manipulation.trajectories import (
    JointLimits,
    Load,
    MotionConfig,
    joint_path,
    line_motion,
    line_postures,
)
from manipulation.types import Rejected

OUT_OF_REACH = Rejected("out of reach", by_arm=True)

MIDDLE_RADIUS = 0.45  # [m]
MAX_SWING = float(np.deg2rad(45))  # of a level path
_ON_LINE, _NOT_TURNED = 1e-3, 5e-3  # [m], [rad] from a line, of the accuracy of inverse kinematics
_SWING_STEP = 0.1  # [rad] between the postures at which the swing is looked at


Path = list[Float[np.ndarray, "n"]]  # waypoints [rad]


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
        end_margin: float | None = None,
    ) -> Float[np.ndarray, "k n"] | Rejected:
        """Return the postures [rad] of the first collision-free straight line from ``q`` to a target.

        Args:
            q: start posture in [rad].
            targets: TCP poses in descending order of preference.
            width: opening between the pads in [m].
            allowed: contacts that are no collisions.
            end_margin: clearance of robot and carried object that the end of the line keeps from everything,
                in [m]; None for none. What slides along a neighbour is not carried on from there.
        """
        contact = self.world.contact(q, width, allowed)
        if contact is not None:  # before any inverse kinematics
            return self.rejection(contact)
        rejected, T_start, blocked = OUT_OF_REACH, self.kinematics.forward(q), None
        for T_world_target in targets:
            if blocked is not None and _leads_through(T_start, T_world_target, blocked):
                continue
            postures = line_postures(
                self.kinematics,
                q,
                T_world_target,
                self.config,
                is_free=lambda posture: self.world.contact(posture, width, allowed) is None,
            )
            if postures is None:
                continue
            contact = self.world.path_contact(postures, width, allowed)
            if contact is not None:
                blocked = self.kinematics.forward(postures[-1])
            elif end_margin is not None:
                clear = AllowedContacts(robot_margin=end_margin, carried_margin=end_margin)
                contact = self.world.contact(postures[-1], width, clear)
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
    ) -> Path | None:
        """Return waypoints of collision-free straight joint moves from start to goal, both included.

        A blocked direct move is replaced by moves over points above start, goal and between them.

        Args:
            q_start, q_goal: postures in [rad].
            width: opening between the pads in [m].
            margins: clearances of arm and carried object in [m], in descending order; the first that some
                path keeps is used. None is the clearance of the world's configuration.

        Returns:
            The waypoints in [rad], or None if no candidate path is free.
        """
        return _Candidates(self, q_start, q_goal, width, margins).first(lambda path: True)

    def any_path(
        self,
        q_start: Float[np.ndarray, "n"],
        q_goal: Float[np.ndarray, "n"],
        width: float,
        margins: Sequence[float | None] = (None,),
    ) -> Path | None:
        """Return a path as ``free_path`` does, or one that is found by a search (``path_search``).

        The search takes up to seconds where there is none: it is for ways that must be found, not for
        candidates of a plan. It keeps the smallest clearance.
        """
        path = self.free_path(q_start, q_goal, width, margins)
        if path is not None:
            return path
        allowed = AllowedContacts(robot_margin=margins[-1], carried_margin=margins[-1])

        def is_free(begin: np.ndarray, end: np.ndarray) -> bool:
            return self.world.path_contact(np.stack([begin, end]), width, allowed) is None

        if not (is_free(q_start, q_start) and is_free(q_goal, q_goal)):
            return None
        return search_path(q_start, q_goal, is_free, (self.kinematics.lower, self.kinematics.upper))

    def carrying_path(
        self,
        q_start: Float[np.ndarray, "n"],
        q_goal: Float[np.ndarray, "n"],
        width: float,
        margins: Sequence[float | None] = (None,),
    ) -> tuple[Path, bool] | None:
        """Return a path as ``free_path`` does, preferably one on which the hand is level, and whether it is.

        It is level if the hand does not swing, see ``swing``; that comes before larger clearances.
        """
        candidates = _Candidates(self, q_start, q_goal, width, margins)
        level = candidates.first(lambda path: self.swing(path) <= MAX_SWING)
        if level is not None:
            return level, True
        path = candidates.first(lambda path: True)
        return None if path is None else (path, False)

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

    def time_line(self, postures: Float[np.ndarray, "k n"], load: Load = "none") -> JointTrajectory:
        """Return the trajectory along the postures [rad] of a straight TCP line, see ``MotionConfig``."""
        start, end = (self.kinematics.forward(q)[:3, 3] for q in (postures[0], postures[-1]))
        return line_motion(postures, float(np.linalg.norm(end - start)), self.limits, self.config, load)

    def candidate_paths(
        self, q_start: Float[np.ndarray, "n"], q_goal: Float[np.ndarray, "n"]
    ) -> Iterator[Path]:
        """Yield paths [rad] in descending order of preference, the direct one first, free or not."""
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


class _Candidates:
    """Candidate paths between two postures, and what is known of the clearances that they keep.

    A path that does not keep the smallest clearance keeps none: that is checked first, except of the direct
    path, which mostly is free. So a search that finds nothing checks every path about once.

    Args:
        motions: planner of the paths.
        q_start, q_goal: postures in [rad].
        width: opening between the pads in [m].
        margins: clearances in [m], in descending order.
    """

    def __init__(
        self,
        motions: MotionPlanner,
        q_start: np.ndarray,
        q_goal: np.ndarray,
        width: float,
        margins: Sequence[float | None],
    ) -> None:
        self._motions, self._width, self._margins = motions, width, margins
        self._remaining = motions.candidate_paths(q_start, q_goal)
        self._paths: list[Path] = []
        self._keeps: dict[tuple[int, int], bool] = {}  # by the numbers of path and margin

    def first(self, is_suitable: Callable[[Path], bool]) -> Path | None:
        """Return the first suitable path that keeps the largest clearance that any of them keeps."""
        for margin in range(len(self._margins)):
            for number, path in enumerate(self._all()):
                if self._may_be_free(number, margin) and is_suitable(path) and self._is_free(number, margin):
                    return path
        return None

    def _all(self) -> Iterator[Path]:
        """Yield all paths; each is made once."""
        yield from self._paths
        for path in self._remaining:
            self._paths.append(path)
            yield path

    def _may_be_free(self, number: int, margin: int) -> bool:
        return self._keeps.get((number, len(self._margins) - 1), True) and self._keeps.get(
            (number, margin), True
        )

    def _is_free(self, number: int, margin: int) -> bool:
        last = len(self._margins) - 1
        order = (margin,) if number == 0 else (last, margin)
        return all(self._keeps_margin(number, m) for m in order)

    def _keeps_margin(self, number: int, margin: int) -> bool:
        if (number, margin) not in self._keeps:
            allowed = AllowedContacts(
                robot_margin=self._margins[margin], carried_margin=self._margins[margin]
            )
            postures = np.stack(self._paths[number])
            contact = self._motions.world.path_contact(postures, self._width, allowed)
            self._keeps[number, margin] = contact is None
        return self._keeps[number, margin]


def _leads_through(
    T_start: Float[np.ndarray, "4 4"], T_goal: Float[np.ndarray, "4 4"], T_between: Float[np.ndarray, "4 4"]
) -> bool:
    """Return whether a line without rotation from one pose to another goes through a third one."""
    whole, part = T_goal[:3, 3] - T_start[:3, 3], T_between[:3, 3] - T_start[:3, 3]
    length = max(float(np.linalg.norm(whole)), 1e-9)
    along = float(part @ whole) / length
    is_on_line = 0.0 < along <= length + _ON_LINE and np.linalg.norm(part - along * whole / length) < _ON_LINE
    turned = max(np.abs(T[:3, :3] - T_start[:3, :3]).max() for T in (T_goal, T_between))
    return bool(is_on_line and turned < _NOT_TURNED)
