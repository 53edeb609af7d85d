"""The one interface between planning and a robot, simulated or real, and what describes its arm."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from perception.types import RgbdFrame


@dataclass(frozen=True)
class GripperGeometry:
    """The parallel gripper as grasp heuristics need it, in [m].

    Attributes:
        max_width: largest opening between the pads.
        pad_half_height: half the height of a pad along the approach.
        pad_thickness: of a finger at its tip, along the closing direction.
        tip: how far the fingertips reach beyond the TCP.
        finger_thickness: of a finger above its pad, along the closing direction.
        finger_reach: from a pad's face to the back of its finger, along the closing direction.
        palm: distance from the TCP back to the palm.
        palm_half_length, palm_half_width: of the palm, along the closing direction and across it.
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


@dataclass(frozen=True)
class ArmDescription:
    """Kinematics and limits of an arm with a parallel gripper.

    The arm stands at the world's origin. Its first joint turns it about z, counterclockwise: from home it is
    turned toward what it is to reach.

    Attributes:
        mjcf: the arm alone as MJCF text (no scene), collision geoms in group 3, for kinematics and collision.
        joint_names: the n arm joints, base to wrist.
        finger_joint_names: the two finger joints, each opening over [0, max_width / 2] in [m].
        tcp_site: site between the finger pads; z points out of the hand, y is the closing direction.
        camera_site: the wrist camera's optical frame (OpenCV axes).
        q_home: (n,) a comfortable posture in [rad].
        velocity_limit, acceleration_limit, jerk_limit: (n,) in [rad/s], [rad/s^2], [rad/s^3].
        gripper: its geometry.
    """

    mjcf: str
    joint_names: tuple[str, ...]
    finger_joint_names: tuple[str, str]
    tcp_site: str
    camera_site: str
    q_home: Float[np.ndarray, "n"]
    velocity_limit: Float[np.ndarray, "n"]
    acceleration_limit: Float[np.ndarray, "n"]
    jerk_limit: Float[np.ndarray, "n"]
    gripper: GripperGeometry = field(default_factory=GripperGeometry)

    @property
    def max_width(self) -> float:
        """Largest opening between the pads in [m]."""
        return self.gripper.max_width


@dataclass(frozen=True)
class JointTrajectory:
    """Joint motion sampled at a fixed period.

    Attributes:
        period: time between samples in [s].
        positions, velocities, accelerations: (T, n) in [rad], [rad/s], [rad/s^2]; the last sample is at rest.
    """

    period: float
    positions: Float[np.ndarray, "t n"]
    velocities: Float[np.ndarray, "t n"]
    accelerations: Float[np.ndarray, "t n"]

    @property
    def duration(self) -> float:
        return self.period * (len(self.positions) - 1)


@runtime_checkable
class Robot(Protocol):
    """What a planner may ask of a robot. Nothing here tells where objects are: for that one must look."""

    @property
    def arm(self) -> ArmDescription: ...

    def joint_positions(self) -> Float[np.ndarray, "n"]:
        """Measured arm joint positions in [rad]."""
        ...

    def gripper_width(self) -> float:
        """Measured opening between the pads in [m]."""
        ...

    def follow(self, trajectory: JointTrajectory) -> None:
        """Execute the motion and settle; raises RobotError if it does not start where the arm is."""
        ...

    def move_gripper(self, width: float) -> float:
        """Open or close toward ``width`` in [m] (0 closes with full force) and return the width reached."""
        ...

    def capture(self) -> RgbdFrame:
        """One registered RGB-D image of the wrist camera, with its pose from the measured joint positions."""
        ...
