"""Limits of trajectories, checked beside the robot before a motion begins, from any planner."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.errors import RobotError
from manipulation.robot import ArmDescription, JointTrajectory

SLACK = 1.02  # share of a limit that rounding and resampling may reach


@dataclass(frozen=True)
class MotionLimits:
    """Limits of the joints.

    Attributes:
        joint_names: names of the n joints.
        lower, upper: (n,) range of the positions in [rad].
        velocity, acceleration: (n,) largest magnitudes in [rad/s], [rad/s^2].
        start_tolerance: largest distance of the first sample from the measured positions in [rad].
        duration: longest trajectory in [s].
    """

    joint_names: tuple[str, ...]
    lower: Float[np.ndarray, "n"]
    upper: Float[np.ndarray, "n"]
    velocity: Float[np.ndarray, "n"]
    acceleration: Float[np.ndarray, "n"]
    start_tolerance: float = 0.03
    duration: float = 120.0

    @staticmethod
    def of(arm: ArmDescription) -> MotionLimits:
        """Return the limits in the description of an arm."""
        from manipulation.arm_model import joint_range, kinematic_model

        lower, upper = joint_range(kinematic_model(arm), arm.joint_names)
        return MotionLimits(arm.joint_names, lower, upper, arm.velocity_limit, arm.acceleration_limit)

    def check(self, trajectory: JointTrajectory, q: Float[np.ndarray, "n"]) -> None:
        """Check a trajectory that is to start at the measured positions.

        Args:
            trajectory: the trajectory.
            q: (n,) measured joint positions in [rad].

        Raises:
            RobotError: it exceeds a limit; the message names the joint. The arm must not be moved.
        """
        positions = trajectory.positions
        if positions.ndim != 2 or positions.shape[1] != len(self.joint_names):
            raise RobotError(f"a trajectory needs {len(self.joint_names)} columns, got {positions.shape}")
        values = (positions, trajectory.velocities, trajectory.accelerations)
        if not all(value.shape == positions.shape and np.isfinite(value).all() for value in values):
            raise RobotError("the samples of the trajectory are not finite or differ in shape")
        if trajectory.duration > self.duration:
            raise RobotError(
                f"the trajectory takes {trajectory.duration:.1f} s of {self.duration:g} s at most"
            )
        between = np.diff(positions, axis=0) / trajectory.period
        beyond = np.maximum(self.lower - positions, positions - self.upper)
        self._require(
            "starts {:.3f} rad from the measured position of", positions[:1] - q, self.start_tolerance
        )
        self._require("leaves by {:.3f} rad the range of", np.maximum(beyond, 0), 1e-6)
        self._require("moves at {:.2f} rad/s, too fast for", trajectory.velocities, SLACK * self.velocity)
        self._require("jumps at {:.2f} rad/s between samples of", between, SLACK * self.velocity)
        self._require(
            "accelerates at {:.1f} rad/s^2, too much for", trajectory.accelerations, SLACK * self.acceleration
        )
        if np.abs(trajectory.velocities[-1]).max() > 1e-3:
            raise RobotError("the trajectory does not end at rest")

    def _require(self, what: str, values: np.ndarray, limit: np.ndarray | float) -> None:
        """Raise RobotError with the joint that exceeds its limit most; ``what`` has a place for its value."""
        largest = np.abs(values).max(axis=0, initial=0.0)
        excess = largest - limit
        joint = int(excess.argmax())
        if excess[joint] > 0:
            raise RobotError(f"the trajectory {what.format(largest[joint])} {self.joint_names[joint]}")
