"""Restricts a robot to its planning interface, so that ground truth is out of reach by construction."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from manipulation.robot import (
    ArmDescription,
    JointTrajectory,
    Robot,
    RobotState,
    capture_depth,
    follow_opening,
)
from perception.types import RgbdFrame


def restricted(robot: Robot) -> Robot:
    """Return an object with the members of ``Robot`` and its extensions alone, each forwarded to ``robot``.

    The extensions are ``DepthCamera`` and ``HandInMotion``; a robot without them does what they do otherwise.
    A simulated robot has further members: its physics state, its configuration, cameras outside the arm. The
    returned object holds none of them, nor a reference to the robot in an attribute.
    """

    class RestrictedRobot:
        __slots__ = ()

        @property
        def arm(self) -> ArmDescription:
            return robot.arm

        def state(self) -> RobotState:
            return robot.state()

        def joint_positions(self) -> Float[np.ndarray, "n"]:
            return robot.joint_positions()

        def gripper_width(self) -> float:
            return robot.gripper_width()

        def follow(self, trajectory: JointTrajectory) -> None:
            robot.follow(trajectory)

        def move_gripper(self, width: float) -> float:
            return robot.move_gripper(width)

        def follow_opening(self, trajectory: JointTrajectory, width: float) -> float:
            return follow_opening(robot, trajectory, width)

        def capture(self) -> RgbdFrame:
            return robot.capture()

        def capture_depth(self) -> RgbdFrame:
            return capture_depth(robot)

        def stop(self, reason: str) -> None:
            robot.stop(reason)

    return RestrictedRobot()
