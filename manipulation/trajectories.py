"""Jerk-limited trajectories: joint-space moves and straight lines of the TCP.

Every trajectory is a 1-D time-optimal profile along a path: of ruckig along the straight segment between two
postures, of ``path_timing`` along a spline through IK solutions on a straight TCP line.
The arm therefore stays on the path that was checked for collisions. (Ruckig's phase synchronisation of
several joints can fall back to time synchronisation, which deviates from the straight segment by up to 0.05
rad.)

Ruckig computes paths with intermediate positions in a remote service, so they are never set: moves through
several waypoints are chained, each ending at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import ruckig
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from manipulation.errors import PlanningError
from manipulation.kinematics import Kinematics
from manipulation.path_timing import PathLimits, fastest
from manipulation.robot import ArmDescription, JointTrajectory

PERIOD = 0.002  # [s] between samples

_ROTATION_STEP, _ROTATION_SPACING = 0.2, 0.05  # [rad] between IK solutions and postures on a line, at most
_HALVINGS = 2  # of the distance between IK solutions
_OFF_LINE, _TURNED_OFF = 3e-4, 2e-3  # [m], [rad] from the line between two solutions, at most

Load = Literal["none", "carried", "pushed"]  # what an object has to do with the motion of the hand


@dataclass(frozen=True)
class MotionConfig:
    """Speed limits of trajectories.

    Attributes:
        velocity_scale, acceleration_scale, jerk_scale: factors on the arm's joint limits.
        line_speed, line_acceleration: limits of straight TCP lines of the empty hand in [m/s], [m/s^2].
        carrying_speed, carrying_acceleration: the same with an object in the hand.
        pushing_speed, pushing_acceleration: the same while the hand pushes or presses an object.
        line_averaging: time in [s] over which the acceleration along a line changes from 0 to its limit.
        line_step: largest distance of the IK solutions along a line in [m].
        line_spacing: largest distance of the postures along it, between which joints move straight, in [m].
        max_line_joint_step: largest joint step between two of the solutions, which are up to 4 times closer
            where it is exceeded, in [rad]; more is a change of IK branch.
    """

    velocity_scale: float = 1.0
    acceleration_scale: float = 1.0
    jerk_scale: float = 1.0
    line_speed: float = 0.8
    line_acceleration: float = 3.0
    carrying_speed: float = 0.8
    carrying_acceleration: float = 2.0
    pushing_speed: float = 0.25
    pushing_acceleration: float = 1.0
    line_averaging: float = 0.05
    line_step: float = 0.024
    line_spacing: float = 0.006
    max_line_joint_step: float = 0.2

    def of_line(self, load: Load) -> tuple[float, float]:
        """Return speed and acceleration of a straight line in [m/s], [m/s^2]."""
        if load == "carried":
            return self.carrying_speed, self.carrying_acceleration
        if load == "pushed":
            return self.pushing_speed, self.pushing_acceleration
        return self.line_speed, self.line_acceleration


@dataclass(frozen=True)
class JointLimits:
    """Joint limits of a trajectory.

    Attributes:
        velocity, acceleration, jerk: (n,) in [rad/s], [rad/s^2], [rad/s^3].
    """

    velocity: Float[np.ndarray, "n"]
    acceleration: Float[np.ndarray, "n"]
    jerk: Float[np.ndarray, "n"]

    @staticmethod
    def of(arm: ArmDescription, config: MotionConfig) -> JointLimits:
        """Return the arm's limits, scaled by the configuration."""
        return JointLimits(
            config.velocity_scale * np.asarray(arm.velocity_limit, dtype=np.float64),
            config.acceleration_scale * np.asarray(arm.acceleration_limit, dtype=np.float64),
            config.jerk_scale * np.asarray(arm.jerk_limit, dtype=np.float64),
        )


def joint_move(
    q_start: Float[np.ndarray, "n"], q_goal: Float[np.ndarray, "n"], limits: JointLimits
) -> JointTrajectory:
    """Return the time-optimal move from rest to rest along the straight segment in joint space.

    Raises:
        PlanningError: a posture is not finite or has the wrong number of joints.
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
    distance = np.maximum(np.abs(step), 1e-9)
    s, ds, dds = _profile(
        float((limits.velocity / distance).min()),
        float((limits.acceleration / distance).min()),
        float((limits.jerk / distance).min()),
    )
    return JointTrajectory(PERIOD, q_start + s[:, None] * step, ds[:, None] * step, dds[:, None] * step)


def joint_path(waypoints: Sequence[Float[np.ndarray, "n"]], limits: JointLimits) -> JointTrajectory:
    """Return joint moves through the waypoints [rad], at rest in each of them.

    Raises:
        PlanningError: there are fewer than two waypoints.
    """
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
    is_free: Callable[[Float[np.ndarray, "n"]], bool] = lambda q: True,
) -> Float[np.ndarray, "k n"] | None:
    """Return postures [rad] along the straight TCP line from ``q_start`` to the goal; None if IK fails on it.

    Position is interpolated linearly, orientation along the geodesic. A cubic spline goes through IK
    solutions at most ``line_step`` apart, closer where it would leave the line; the postures are at most
    ``line_spacing`` apart. An IK solution that is not free ends the line: it is the last posture then, and
    the postures are the solutions.
    """
    line = _TcpLine.between(kinematics.forward(q_start), T_world_goal)
    n_postures = line.intervals(config.line_spacing, _ROTATION_SPACING)
    for halving in range(_HALVINGS + 1):
        n_solutions = line.intervals(config.line_step / 2**halving, _ROTATION_STEP / 2**halving)
        postures = _solve(kinematics, q_start, line, n_solutions, name, is_free)
        if postures is None or len(postures) <= n_solutions:
            return postures
        if np.abs(np.diff(postures, axis=0)).max() > config.max_line_joint_step:
            continue
        spline = CubicSpline(np.linspace(0.0, 1.0, n_solutions + 1), postures, axis=0)
        if halving == _HALVINGS or _is_on_line(kinematics, spline, line, n_solutions):
            return spline(np.linspace(0.0, 1.0, n_postures + 1))
    return None


@dataclass(frozen=True)
class _TcpLine:
    """A straight line of the TCP between two poses T_world_tcp.

    Attributes:
        T_start: (4, 4) first pose.
        shift: (3,) translation to the last one in [m].
        rotation: (3,) rotation vector to it in the frame of the first one, in [rad].
    """

    T_start: Float[np.ndarray, "4 4"]
    shift: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3"]

    @staticmethod
    def between(T_start: Float[np.ndarray, "4 4"], T_goal: Float[np.ndarray, "4 4"]) -> _TcpLine:
        rotation = Rotation.from_matrix(T_start[:3, :3].T @ T_goal[:3, :3]).as_rotvec()
        return _TcpLine(T_start, T_goal[:3, 3] - T_start[:3, 3], rotation)

    def intervals(self, length: float, angle: float) -> int:
        """Return into how many equal ones of at most a length [m] and an angle [rad] the line is divided."""
        by_length = np.linalg.norm(self.shift) / length
        return max(int(np.ceil(max(by_length, np.linalg.norm(self.rotation) / angle))), 2)

    def poses(self, shares: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k 4 4"]:
        """Return the poses at shares of the line."""
        T = np.tile(np.eye(4), (len(shares), 1, 1))
        T[:, :3, 3] = self.T_start[:3, 3] + np.outer(shares, self.shift)
        T[:, :3, :3] = (
            self.T_start[:3, :3] @ Rotation.from_rotvec(np.outer(shares, self.rotation)).as_matrix()
        )
        return T


def _solve(
    kinematics: Kinematics,
    q_start: Float[np.ndarray, "n"],
    line: _TcpLine,
    n_steps: int,
    name: str,
    is_free: Callable[[Float[np.ndarray, "n"]], bool],
) -> Float[np.ndarray, "k n"] | None:
    """Return IK solutions [rad] at equal steps of a line, its start included; None if one is missing.

    Each search starts where the two solutions before it point to. One that is not free is the last.
    """
    postures = [np.asarray(q_start, dtype=np.float64)]
    for T in line.poses(np.arange(1, n_steps + 1) / n_steps):
        seeds = [2 * postures[-1] - postures[-2]] if len(postures) > 1 else []
        result = kinematics.inverse(T, [*seeds, postures[-1]], name=name)
        if not result.converged:
            return None
        postures.append(result.q)
        if not is_free(result.q):
            break
    return np.stack(postures)


def _is_on_line(kinematics: Kinematics, spline: CubicSpline, line: _TcpLine, n_steps: int) -> bool:
    """Return whether a spline through solutions at equal steps is on the line half-way between them too."""
    shares = (np.arange(n_steps) + 0.5) / n_steps
    error = np.stack([kinematics.forward(q) for q in spline(shares)]) - line.poses(shares)
    off = np.linalg.norm(error[:, :3, 3], axis=1).max()
    turn = np.linalg.norm(error[:, :3, :3], axis=(1, 2)).max() / np.sqrt(2)  # of a small angle
    return bool(off <= _OFF_LINE and turn <= _TURNED_OFF)


def line_motion(
    postures: Float[np.ndarray, "k n"],
    length: float,
    limits: JointLimits,
    config: MotionConfig,
    load: Load = "none",
) -> JointTrajectory:
    """Return the trajectory along a cubic spline through the postures of a line of ``length`` [m].

    It is slow where the joint limits require it, as near a singularity or where a joint reaches its end;
    ``load`` chooses its speed and acceleration.

    Raises:
        PlanningError: the limits cannot be kept.
    """
    spline = CubicSpline(np.linspace(0.0, 1.0, len(postures)), postures, axis=0)
    length = max(length, 1e-6)
    speed, acceleration = config.of_line(load)
    allowed = PathLimits(
        limits.velocity,
        limits.acceleration,
        speed / length,
        acceleration / length,
        window=config.line_averaging,
    )
    for _ in range(8):
        motion = fastest(spline, allowed, PERIOD)
        tangent, curvature = spline(motion.s, 1), spline(motion.s, 2)
        velocities = tangent * motion.ds[:, None]
        accelerations = tangent * motion.dds[:, None] + curvature * (motion.ds**2)[:, None]
        excess = max(
            np.max(np.abs(velocities) / limits.velocity),
            np.sqrt(np.max(np.abs(accelerations) / limits.acceleration)),
        )
        if excess <= 1.0:
            return JointTrajectory(PERIOD, spline(motion.s), velocities, accelerations)
        allowed = allowed.slower(1.02 * float(excess))
    raise PlanningError("a straight line passes too close to a singularity to keep the joint limits")


def concatenate(parts: Sequence[JointTrajectory]) -> JointTrajectory:
    """Return one trajectory from several, each of which starts where the one before it ends.

    Raises:
        PlanningError: two of them do not meet.
    """
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
    """Return (t,) position, velocity and acceleration of the time-optimal motion from 0 to 1."""
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
