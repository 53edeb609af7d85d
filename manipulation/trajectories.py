"""Jerk-limited motions: joint-space moves and straight lines of the TCP.

Every motion is a 1-D time-optimal profile (ruckig) along a path: the straight line between two postures, or
the spline through postures that inverse kinematics finds every few millimetres of a straight TCP line. So the
arm stays on the very path that was checked for collisions. (Ruckig's own phase synchronisation of several
joints falls back to time synchronisation now and then, and strays by 0.05 rad.)

Ruckig sends paths with intermediate positions to a remote service. They are never set here: moves through
several points are chained, each ending at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import ruckig
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.robot import ArmDescription, JointTrajectory

PERIOD = 0.002


@dataclass(frozen=True)
class MotionConfig:
    """How fast the arm may move, as shares of its limits.

    Attributes:
        velocity_share, acceleration_share, jerk_share: of the arm's joint limits.
        line_speed, line_acceleration, line_jerk: of straight TCP lines in [m/s], [m/s^2], [m/s^3].
        line_step: spacing of the supports of a line in [m].
        max_line_joint_step: largest joint step between two supports in [rad]; more is a flip of the arm.
    """

    velocity_share: float = 1.0
    acceleration_share: float = 1.0
    jerk_share: float = 1.0
    line_speed: float = 0.25
    line_acceleration: float = 1.0
    line_jerk: float = 15.0
    line_step: float = 0.006
    max_line_joint_step: float = 0.2


@dataclass(frozen=True)
class JointLimits:
    """Limits a motion has to keep: (n,) in [rad/s], [rad/s^2], [rad/s^3]."""

    velocity: Float[np.ndarray, "n"]
    acceleration: Float[np.ndarray, "n"]
    jerk: Float[np.ndarray, "n"]

    @staticmethod
    def of(arm: ArmDescription, config: MotionConfig) -> JointLimits:
        return JointLimits(
            config.velocity_share * np.asarray(arm.velocity_limit, dtype=np.float64),
            config.acceleration_share * np.asarray(arm.acceleration_limit, dtype=np.float64),
            config.jerk_share * np.asarray(arm.jerk_limit, dtype=np.float64),
        )


def joint_move(
    q_start: Float[np.ndarray, "n"], q_goal: Float[np.ndarray, "n"], limits: JointLimits
) -> JointTrajectory:
    """Time-optimal move from rest to rest along the straight line in joint space.

    Raises:
        PlanningError: the request is invalid (not finite, wrong size).
    """
    q_start, q_goal = np.asarray(q_start, dtype=np.float64), np.asarray(q_goal, dtype=np.float64)
    if q_start.shape != limits.velocity.shape or q_goal.shape != limits.velocity.shape:
        raise PlanningError(
            f"a joint move from {q_start.shape} to {q_goal.shape} positions does not fit "
            f"{len(limits.velocity)} joints"
        )
    if not (np.isfinite(q_start).all() and np.isfinite(q_goal).all()):
        raise PlanningError(f"a joint move from {q_start.tolist()} to {q_goal.tolist()} is not finite")
    step = q_goal - q_start
    if np.abs(step).max() < 1e-9:
        still = np.zeros((1, len(q_goal)))
        return JointTrajectory(PERIOD, q_goal[None], still, still)
    share = np.maximum(np.abs(step), 1e-9)
    s, ds, dds = _profile(
        float((limits.velocity / share).min()),
        float((limits.acceleration / share).min()),
        float((limits.jerk / share).min()),
    )
    return JointTrajectory(PERIOD, q_start + s[:, None] * step, ds[:, None] * step, dds[:, None] * step)


def joint_path(waypoints: Sequence[Float[np.ndarray, "n"]], limits: JointLimits) -> JointTrajectory:
    """Joint moves through the waypoints, at rest in each of them."""
    moves = [joint_move(a, b, limits) for a, b in itertools.pairwise(waypoints)]
    if not moves:
        raise PlanningError("a joint path needs at least two waypoints")
    return concatenate(moves)


def line_postures(
    kinematics: Kinematics,
    q_start: Float[np.ndarray, "n"],
    T_world_goal: Float[np.ndarray, "4 4"],
    config: MotionConfig,
    name: str = "line",
) -> Float[np.ndarray, "k n"] | None:
    """Postures along the straight TCP line from ``q_start`` to the goal, or None if the arm cannot follow it.

    Position is interpolated linearly, orientation along the geodesic; supports are ``line_step`` apart.
    """
    T_start = kinematics.forward(q_start)
    turn = Rotation.from_matrix(T_start[:3, :3].T @ T_world_goal[:3, :3]).as_rotvec()
    length = np.linalg.norm(T_world_goal[:3, 3] - T_start[:3, 3])
    n_steps = max(int(np.ceil(length / config.line_step)), int(np.ceil(np.linalg.norm(turn) / 0.05)), 2)
    postures = [np.asarray(q_start, dtype=np.float64)]
    for share in np.arange(1, n_steps + 1) / n_steps:
        T = np.eye(4)
        T[:3, 3] = (1 - share) * T_start[:3, 3] + share * T_world_goal[:3, 3]
        T[:3, :3] = T_start[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
        result = kinematics.inverse(T, [postures[-1]], name=name)
        if not result.converged or np.abs(result.q - postures[-1]).max() > config.max_line_joint_step:
            return None
        postures.append(result.q)
    return np.stack(postures)


def line_motion(
    postures: Float[np.ndarray, "k n"], length: float, limits: JointLimits, config: MotionConfig
) -> JointTrajectory:
    """Motion along a cubic spline through the postures of a line of ``length`` [m], timed from rest to rest.

    Where the arm would have to turn too fast (near a singular posture) the whole line is slowed down.
    """
    spline = CubicSpline(np.linspace(0.0, 1.0, len(postures)), postures, axis=0)
    length = max(length, 1e-6)
    slowdown = 1.0
    for _ in range(8):
        s, ds, dds = _profile(
            config.line_speed / length / slowdown,
            config.line_acceleration / length / slowdown**2,
            config.line_jerk / length / slowdown**3,
        )
        tangent, curvature = spline(s, 1), spline(s, 2)
        velocities = tangent * ds[:, None]
        accelerations = tangent * dds[:, None] + curvature * (ds**2)[:, None]
        excess = max(
            np.max(np.abs(velocities) / limits.velocity),
            np.sqrt(np.max(np.abs(accelerations) / limits.acceleration)),
        )
        if excess <= 1.0:
            return JointTrajectory(PERIOD, spline(s), velocities, accelerations)
        slowdown *= 1.02 * excess
    raise PlanningError("a straight line passes too close to a singular posture to be timed")


def concatenate(parts: Sequence[JointTrajectory]) -> JointTrajectory:
    """One trajectory from several that meet at rest."""
    for before, after in itertools.pairwise(parts):
        if not np.allclose(before.positions[-1], after.positions[0], atol=1e-4):
            raise PlanningError("trajectories to be chained do not meet")
    return JointTrajectory(
        parts[0].period,
        np.concatenate([parts[0].positions, *(part.positions[1:] for part in parts[1:])]),
        np.concatenate([parts[0].velocities, *(part.velocities[1:] for part in parts[1:])]),
        np.concatenate([parts[0].accelerations, *(part.accelerations[1:] for part in parts[1:])]),
    )


def _profile(velocity: float, acceleration: float, jerk: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """From 0 to 1, rest to rest, within the limits: (t,) position, velocity, acceleration per sample."""
    request = ruckig.InputParameter(1)
    request.current_position, request.target_position = [0.0], [1.0]
    request.max_velocity, request.max_acceleration, request.max_jerk = [velocity], [acceleration], [jerk]
    otg, motion = ruckig.Ruckig(1), ruckig.Trajectory(1)
    try:
        otg.validate_input(request, check_current_state_within_limits=True)
        result = otg.calculate(request, motion)
    except ruckig.RuckigError as error:
        raise PlanningError(f"no motion profile: {str(error).strip()}") from error
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise PlanningError(f"no motion profile: {result}")
    times = PERIOD * np.arange(int(np.ceil(motion.duration / PERIOD)) + 1)
    states = np.array([motion.at_time(t)[:3] for t in times], dtype=np.float64).reshape(len(times), 3)
    states[-1] = 1.0, 0.0, 0.0
    return states[:, 0].clip(0.0, 1.0), states[:, 1], states[:, 2]
