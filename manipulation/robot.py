"""Interface between planning and a robot, simulated or real, and the description of its arm."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from perception.types import RgbdFrame


@dataclass(frozen=True)
class GripperGeometry:
    """Dimensions of a parallel gripper in [m].

    Attributes:
        max_width: largest opening between the pads.
        pad_half_height: half the height of a pad along the approach.
        pad_thickness: thickness of a finger at its tip, along the closing direction.
        tip: distance of the fingertips beyond the TCP.
        finger_thickness: thickness of a finger above its pad, along the closing direction.
        finger_reach: distance from a pad's face to the back of its finger, along the closing direction.
        palm: distance from the TCP back to the palm.
        palm_half_length, palm_half_width: half extents of the palm along and across the closing direction.
        min_width: opening between the pads of the closed hand; above 0 where the pads do not meet.
        finger_half_width: half extent of a finger across the closing direction.
        one_jaw: whether only the finger on the side of +y of the TCP moves; the TCP is on the other's pad.
    """

    max_width: float = 0.08
    pad_half_height: float = 0.0085
    pad_thickness: float = 0.010
    tip: float = 0.0095
    finger_thickness: float = 0.0185
    finger_reach: float = 0.0205
    palm: float = 0.037
    palm_half_length: float = 0.105
    palm_half_width: float = 0.035
    min_width: float = 0.0
    finger_half_width: float = 0.01
    one_jaw: bool = False

    def pads_middle(self, width: float) -> float:
        """Return the distance [m] from the TCP along its y axis to the middle of pads ``width`` [m] apart."""
        return 0.5 * width if self.one_jaw else 0.0


@dataclass(frozen=True)
class FingerMotion:
    """Positions of a hand's joints as a function of the opening between its pads.

    The same for sliding fingers and for linkages; between the tabulated openings it is linear.

    Attributes:
        joint_names: names of the m joints of the hand, those that are driven first.
        widths: (k,) openings between the pads in ascending order, in [m].
        positions: (k, m) joint positions at the openings, in [m] or [rad].
        n_driven: number of driven joints.
    """

    joint_names: tuple[str, ...]
    widths: Float[np.ndarray, "k"]
    positions: Float[np.ndarray, "k m"]
    n_driven: int

    @staticmethod
    def sliding(joint_names: tuple[str, str], max_width: float) -> FingerMotion:
        """Return the motion of two fingers that each slide from 0 (pads meet) to ``max_width / 2`` [m]."""
        ends = np.array([[0.0, 0.0], [max_width / 2, max_width / 2]])
        return FingerMotion(joint_names, np.array([0.0, max_width]), ends, 2)

    def at(self, width: float) -> Float[np.ndarray, "m"]:
        """Return the joint positions at an opening [m], clipped to the range of openings."""
        return np.array([np.interp(width, self.widths, column) for column in self.positions.T])

    def width(self, driven: Float[np.ndarray, "_d"]) -> float:
        """Return the opening [m] at positions of the driven joints: the mean of what each implies."""
        found = [np.interp(position, *table) for position, table in zip(driven, self._tables, strict=True)]
        return float(sum(found) / len(found))  # a third of the time of np.mean, in every physics step

    @cached_property
    def _tables(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Ascending positions of each driven joint, and the openings there [m]."""
        columns = self.positions.T[: self.n_driven]
        return [(column[order], self.widths[order]) for column in columns for order in [np.argsort(column)]]


@dataclass(frozen=True)
class ArmDescription:
    """Kinematics and limits of an arm with a parallel gripper.

    The base frame is the world frame. The first joint rotates the arm counterclockwise about z; inverse
    kinematics is seeded with the home posture rotated toward the target.

    Attributes:
        mjcf: MJCF text of the arm without a scene; its collision geoms are in group 3.
        joint_names: names of the n arm joints, base to wrist.
        fingers: joints of the hand and their positions over the opening between the pads.
        tcp_site: site between the finger pads; z points out of the hand, y is the closing direction.
        camera_site: optical frame of the wrist camera (OpenCV axes).
        q_home: (n,) home posture in [rad].
        velocity_limit, acceleration_limit, jerk_limit: (n,) joint limits in [rad/s], [rad/s^2], [rad/s^3].
        gripper: geometry of the gripper.
        near_views: whether viewpoints that the camera cannot reach are replaced by near ones.
    """

    mjcf: str
    joint_names: tuple[str, ...]
    fingers: FingerMotion
    tcp_site: str
    camera_site: str
    q_home: Float[np.ndarray, "n"]
    velocity_limit: Float[np.ndarray, "n"]
    acceleration_limit: Float[np.ndarray, "n"]
    jerk_limit: Float[np.ndarray, "n"]
    gripper: GripperGeometry = field(default_factory=GripperGeometry)
    near_views: bool = False

    @property
    def max_width(self) -> float:
        """Largest opening between the pads in [m]."""
        return self.gripper.max_width


@dataclass(frozen=True)
class JointTrajectory:
    """Joint trajectory sampled at a fixed period.

    Attributes:
        period: time between samples in [s].
        positions, velocities, accelerations: (t, n) in [rad], [rad/s], [rad/s^2]; the last sample is at rest.
    """

    period: float
    positions: Float[np.ndarray, "t n"]
    velocities: Float[np.ndarray, "t n"]
    accelerations: Float[np.ndarray, "t n"]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample in [s]."""
        return self.period * (len(self.positions) - 1)

    def part(self, begin: int, end: int | None = None) -> JointTrajectory:
        """Return the samples from ``begin`` up to, but without, ``end``; to the last one if None."""
        rows = slice(begin, end)
        return JointTrajectory(
            self.period, self.positions[rows], self.velocities[rows], self.accelerations[rows]
        )

    def reversed(self) -> JointTrajectory:
        """Return the trajectory run backwards; it must begin at rest."""
        return JointTrajectory(
            self.period, self.positions[::-1], -self.velocities[::-1], self.accelerations[::-1]
        )


@dataclass(frozen=True)
class RobotState:
    """Measured state of an arm.

    Attributes:
        time: time of the measurement in [s], on the clock of the images.
        positions: (n,) joint positions in [rad].
        gripper_width: opening between the pads in [m].
    """

    time: float
    positions: Float[np.ndarray, "n"]
    gripper_width: float


@runtime_checkable
class Robot(Protocol):
    """Commands and measurements of an arm with a gripper and a wrist camera, without any object poses.

    Measurements are current: an implementation never returns a joint state or an image that is older than the
    end of the last motion. Motions raise ``RobotStoppedError`` once the robot has been stopped.
    """

    @property
    def arm(self) -> ArmDescription:
        """Description of the arm."""
        ...

    def state(self) -> RobotState:
        """Return the measured state with its time."""
        ...

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        """Return the measured arm joint positions in [rad]."""
        ...

    def gripper_width(self) -> float:
        """Return the measured opening between the pads in [m]."""
        ...

    def follow(self, trajectory: JointTrajectory) -> None:
        """Execute the trajectory and wait until the arm is at rest.

        Raises:
            RobotError: the trajectory does not start at the present posture or exceeds a limit, and was not
                begun; or the motion is blocked.
            RobotStoppedError: the robot was stopped.
        """
        ...

    def move_gripper(self, width: float) -> float:
        """Move the pads toward ``width`` in [m] (0 closes with full force) and return the width reached."""
        ...

    def capture(self) -> RgbdFrame:
        """Return a registered RGB-D image with the camera pose from the joint positions at its exposure.

        The camera pose is the tool's pose times the hand-eye calibration.
        """
        ...

    def stop(self, reason: str) -> None:
        """Brake and hold the posture, with the gripper as it is; further motions raise ``RobotStoppedError``.

        It returns at once and may be called from another thread during a motion. Only a person releases it,
        at the robot. It is no substitute for an emergency stop.
        """
        ...


@runtime_checkable
class DepthCamera(Protocol):
    """What a ``Robot`` may have besides: images that cost less because nobody reads their colour."""

    def capture_depth(self) -> RgbdFrame:
        """Return what ``Robot.capture`` returns, but for the colour image, which may be black."""
        ...


@runtime_checkable
class HandInMotion(Protocol):
    """What a ``Robot`` may have besides: its hand opens while the arm moves, which saves the time for it."""

    def follow_opening(self, trajectory: JointTrajectory, width: float) -> float:
        """Do what ``Robot.follow`` and ``Robot.move_gripper`` do, at the same time; return the width reached.

        It returns when the arm is at rest and the pads are ``width`` [m] apart or at rest.
        """
        ...


def follow_opening(robot: Robot, trajectory: JointTrajectory, width: float) -> float:
    """Move arm and empty hand, at the same time if the robot can; return the opening reached in [m]."""
    if isinstance(robot, HandInMotion):
        return robot.follow_opening(trajectory, width)
    reached = robot.move_gripper(width)
    robot.follow(trajectory)
    return reached


def capture_depth(robot: Robot) -> RgbdFrame:
    """Return an image of which only depth and pose are read, in the least time that the robot offers."""
    return robot.capture_depth() if isinstance(robot, DepthCamera) else robot.capture()
