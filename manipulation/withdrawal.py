"""Motions of the hand away from what stands around it, before the camera moves or another plan begins.

After a release or a failed grasp the hand is among objects, perhaps within their clearances, where every path
begins with a collision. A straight line that leads out of them is followed first; what the hand is near to at
its beginning counts as touched until it is left.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.collision import AllowedContacts
from manipulation.errors import RobotError
from manipulation.motions import MotionPlanner
from manipulation.observation import Finding, Poses, Presence, SceneObserver, Volume
from manipulation.pick_place import PickPlacePlanner
from manipulation.robot import Robot
from manipulation.trajectories import joint_move
from manipulation.types import Rejected
from perception.obstacles.obstacle import PerceivedObstacle

logger = logging.getLogger(__name__)

_STEPS = (0.03, 0.06, 0.10, 0.15)  # [m] lengths of lines out of clearances, the shortest first
_MOVED = 0.05  # [rad] of a joint
HOME_MARGINS = (0.012, 0.004)  # [m] of paths to the home posture, in descending order


def way_out(
    motions: MotionPlanner, q: Float[np.ndarray, "n"], width: float
) -> Float[np.ndarray, "k n"] | None:
    """Return the postures [rad] of a straight line to a posture free of contacts; None if there is none.

    Args:
        motions: motions in the world as it is known, with nothing in the hand.
        q: present posture in [rad].
        width: opening between the pads in [m].
    """
    near = AllowedContacts(touch=motions.world.touched(q, width))
    for T_goal in _lines_out(motions.kinematics.forward(q)):
        line = motions.free_line(q, [T_goal], width, near)
        if not isinstance(line, Rejected) and motions.world.contact(line[-1], width) is None:
            return line
    return None


def _lines_out(T_world_tcp: Float[np.ndarray, "4 4"]) -> Iterator[Float[np.ndarray, "4 4"]]:
    """Yield the TCP poses at the ends of lines: back along the approach, up, and between these."""
    back, up = -T_world_tcp[:3, 2], np.array([0.0, 0.0, 1.0])
    between = (back + up) / max(float(np.linalg.norm(back + up)), 1e-6)
    for step, direction in itertools.product(_STEPS, (back, between, up)):
        T = T_world_tcp.copy()
        T[:3, 3] += step * direction
        yield T


class Withdrawal:
    """Moves the empty hand of a robot away from what is around it.

    Args:
        robot: the robot.
        planner: planner whose scene follows what is seen.
    """

    def __init__(self, robot: Robot, planner: PickPlacePlanner) -> None:
        self._robot, self._planner = robot, planner

    def leave(self) -> bool:
        """Move out of the clearances of what is near; return whether the posture is free of contacts."""
        motions, robot = self._planner.motions, self._robot
        q, width = robot.joint_positions(), robot.gripper_width()
        if motions.world.contact(q, width) is None:
            return True
        line = way_out(motions, q, width)
        return line is not None and self._follow(motions, [line], ())

    def rise(self) -> bool:
        """Move above the objects, where the camera may move on; return whether that was possible."""
        motions, robot = self._planner.motions, self._robot
        width, heights = robot.gripper_width(), motions.via_heights
        if motions.kinematics.forward(robot.joint_positions())[2, 3] >= heights[0] - 1e-3:
            return True
        if not self.leave():
            return False
        q = robot.joint_positions()
        T_now = motions.kinematics.forward(q)
        raised = [T_now.copy() for _ in heights]
        for T, height in zip(raised, heights):
            T[2, 3] = height
        up = motions.free_line(q, raised, width)
        if not isinstance(up, Rejected):
            return self._follow(motions, [up], ())
        home = np.asarray(robot.arm.q_home, dtype=np.float64)
        path = motions.any_path(q, home, width, HOME_MARGINS)
        return path is not None and self._follow(motions, [], path)

    def has_risen(self) -> bool:
        """Move above the objects; return whether the arm is elsewhere then."""
        before = self._robot.joint_positions()
        return self.rise() and bool(np.abs(self._robot.joint_positions() - before).max() > _MOVED)

    def _follow(
        self, motions: MotionPlanner, lines: Sequence[np.ndarray], path: Sequence[np.ndarray]
    ) -> bool:
        """Execute straight lines, then joint moves; return whether the robot could."""
        try:
            for line in lines:
                self._robot.follow(motions.time_line(line))
            for start, goal in itertools.pairwise(path):
                self._robot.follow(joint_move(start, goal, motions.limits))
        except RobotError as error:
            logger.warning("the hand could not be moved away: %s", error)
            return False
        return True


class WithdrawingObserver:
    """An observer before whose camera motions the hand rises above the objects.

    Where it cannot, nothing is known of what it was to look at: the camera is not moved through objects.

    Args:
        observer: looks at the scene.
        withdrawal: moves the hand.
    """

    def __init__(self, observer: SceneObserver, withdrawal: Withdrawal) -> None:
        self._observer, self._withdrawal = observer, withdrawal

    def glance(self, poses: Poses, names: tuple[str, ...]) -> dict[str, Presence]:
        return dict(self._observer.glance(poses, names))

    def unexpected(
        self, poses: Poses, obstacles: Sequence[PerceivedObstacle], region: Volume
    ) -> Float[np.ndarray, "n 3"]:
        return self._observer.unexpected(poses, obstacles, region)

    def held(
        self, name: str, poses: Poses, T_world_tcp: Float[np.ndarray, "4 4"]
    ) -> Float[np.ndarray, "4 4"] | None:
        return self._observer.held(name, poses, T_world_tcp)

    def find(self, name: str, poses: Poses) -> Finding:
        return self._observer.find(name, poses) if self._withdrawal.rise() else Finding("unseen")

    def find_obstacles(self, poses: Poses) -> tuple[PerceivedObstacle, ...] | None:
        return self._observer.find_obstacles(poses) if self._withdrawal.rise() else None

    def look_closer(self, names: Sequence[str], poses: Poses) -> Poses:
        return self._observer.look_closer(names, poses) if self._withdrawal.rise() else {}
