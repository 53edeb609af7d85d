"""Forward kinematics, and inverse kinematics by differential IK (mink) iterated to convergence.

Each step solves the QP  min |J dq - e|^2 + lm |e|^2 |dq|^2 + posture + damping  within the joint limits. The
small posture cost selects one of the redundant solutions; its bias of the pose is below the tolerances.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import mink
import numpy as np
from jaxtyping import Float

from manipulation.arm_model import joint_addresses, joint_range, kinematic_model, mujoco, site_index
from manipulation.errors import ManipulationError
from manipulation.robot import ArmDescription

_IDENTITY = np.eye(3)
_TASK_DIMENSIONS = 6  # of a pose
_ROTATION_TOLERANCE = 1e-5  # of the product of a rotation matrix and its transpose
_REMEMBERED = 50_000  # descents: a plan without some of the objects repeats most of those with them

Frame = Literal["tcp", "camera"]
IkStatus = Literal["converged", "not_converged"]


@dataclass(frozen=True)
class IkConfig:
    """Settings of the inverse kinematics.

    Attributes:
        position_tolerance: accepted distance from the target in [m].
        rotation_tolerance: accepted rotation from the target in [rad].
        max_iterations: largest number of steps from one seed.
        patience: number of steps without progress (an error 10 % smaller) after which a seed is abandoned.
        limit_margin: distance from the joint limits in [rad].
        dt, lm_damping, damping, posture_cost: parameters of the differential IK.
    """

    position_tolerance: float = 1e-4
    rotation_tolerance: float = 1e-3
    max_iterations: int = 40
    patience: int = 6
    limit_margin: float = 0.05
    dt: float = 0.1
    lm_damping: float = 1e-3
    damping: float = 1e-6
    posture_cost: float = 1e-4


@dataclass(frozen=True)
class IkResult:
    """Best posture that the solver found, with its residual errors.

    Attributes:
        q: (n,) joint positions in [rad].
        status: "converged" if both errors are within the tolerances.
        position_error: distance from the target in [m].
        rotation_error: rotation from the target in [rad].
        iterations: number of steps over all seeds.
    """

    q: Float[np.ndarray, "n"]
    status: IkStatus
    position_error: float
    rotation_error: float
    iterations: int

    @property
    def converged(self) -> bool:
        """Whether the posture reaches the target within the tolerances."""
        return self.status == "converged"


class Kinematics:
    """Kinematics of one arm, for its TCP and its wrist camera; the base frame is the world frame.

    Attributes:
        arm, config: those of the constructor.
        lower, upper: (n,) joint limits in [rad].
        base: (3,) point on the first joint's axis in [m].
        base_turn: direction in which the first joint turns about z: 1, -1, or 0 if its axis is not vertical.

    Raises:
        ManipulationError: the MJCF lacks a named joint or site, or has further joints.
    """

    def __init__(self, arm: ArmDescription, config: IkConfig = IkConfig()) -> None:
        self.arm, self.config = arm, config
        self._model = kinematic_model(arm)
        if self._model.nv != len(arm.joint_names):
            raise ManipulationError(
                f"the arm's MJCF has {self._model.nv} joints besides its fingers, "
                f"but {len(arm.joint_names)} are named"
            )
        self._address = joint_addresses(self._model, arm.joint_names)
        self.lower, self.upper = joint_range(self._model, arm.joint_names)
        self._sites: dict[Frame, str] = {"tcp": arm.tcp_site, "camera": arm.camera_site}
        self._site_ids = {frame: site_index(self._model, name) for frame, name in self._sites.items()}
        self._data = mujoco.MjData(self._model)
        self._configuration = mink.Configuration(self._model)
        # 1 urad wider than the interval seeds are clipped to: a seed on the bound must remain feasible.
        self._limit = mink.ConfigurationLimit(
            self._model, min_distance_from_limits=self.config.limit_margin - 1e-6
        )
        T_world_home = self.forward(np.asarray(arm.q_home, dtype=np.float64))
        first = self._model.joint(arm.joint_names[0]).id
        self.base = self._data.xanchor[first].copy()
        up = self._data.xaxis[first, 2]
        self.base_turn = float(np.sign(up)) if abs(up) > 0.9 else 0.0
        self._home_bearing = round(self.bearing(T_world_home), 6)
        self._descents: dict[tuple[Frame, bytes, bytes], IkResult] = {}
        self._posture = mink.PostureTask(self._model, cost=self.config.posture_cost)
        self._tasks = {
            frame: mink.FrameTask(
                name, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=self.config.lm_damping
            )
            for frame, name in self._sites.items()
        }

    def forward(self, q: Float[np.ndarray, "n"], frame: Frame = "tcp") -> Float[np.ndarray, "4 4"]:
        """Return ``T_world_frame`` at joint positions ``q`` [rad]."""
        self._data.qpos[self._address] = q
        mujoco.mj_kinematics(self._model, self._data)
        site = self._site_ids[frame]
        T = np.eye(4)
        T[:3, :3] = self._data.site_xmat[site].reshape(3, 3)
        T[:3, 3] = self._data.site_xpos[site]
        return T

    def bearing(self, T_world_target: Float[np.ndarray, "4 4"]) -> float:
        """Return the azimuth [rad] of a pose about the first joint's axis."""
        return float(np.arctan2(*(T_world_target[:2, 3] - self.base[:2])[::-1]))

    def anchors(self, q: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """Return the anchors of the joints in [m] at joint positions ``q`` [rad], base to wrist."""
        self.forward(q)
        ids = [self._model.joint(name).id for name in self.arm.joint_names]
        return self._data.xanchor[ids].copy()

    def within_limits(self, q: Float[np.ndarray, "n"], margin: float = 0.0) -> bool:
        """Return whether all joints are at least ``margin`` [rad] within their limits."""
        return bool(np.all(q >= self.lower + margin) and np.all(q <= self.upper - margin))

    def limit_distance(self, q: Float[np.ndarray, "n"]) -> float:
        """Return the smallest distance [rad] of a joint from its limits; negative outside."""
        return float(min(np.min(q - self.lower), np.min(self.upper - q)))

    def inverse(
        self,
        T_world_target: Float[np.ndarray, "4 4"],
        seeds: Sequence[Float[np.ndarray, "n"]],
        frame: Frame = "tcp",
        name: str = "target",
    ) -> IkResult:
        """Return joint positions that bring the frame to the target, from the first seed that converges.

        An unreachable target is not an error: the result has status ``not_converged``.

        Args:
            T_world_target: target pose of the frame.
            seeds: start postures in [rad], tried in order; clipped to the limits.
            frame: frame that is to reach the target.
            name: name of the target in error messages.

        Raises:
            ManipulationError: the target is not a finite rigid transform, or there is no seed.
        """
        _check_target(T_world_target, name)
        if not seeds:
            raise ManipulationError(f"no start posture for the inverse kinematics of {name}")
        target = np.ascontiguousarray(T_world_target, dtype=np.float64)
        best: IkResult | None = None
        iterations = 0
        for seed in seeds:
            result = self._descend_once(target, np.ascontiguousarray(seed, dtype=np.float64), frame)
            iterations += result.iterations
            result = IkResult(
                result.q.copy(), result.status, result.position_error, result.rotation_error, iterations
            )
            if result.converged:
                return result
            if best is None or _error(result) < _error(best):
                best = result
        assert best is not None
        return IkResult(best.q, best.status, best.position_error, best.rotation_error, iterations)

    def seeds_toward(
        self, T_world_target: Float[np.ndarray, "4 4"], count: int = 4
    ) -> list[Float[np.ndarray, "n"]]:
        """Return start postures in [rad]: home rotated toward the target, with another wrist, and random."""
        home = np.array(self.arm.q_home, dtype=np.float64)
        turn = self.bearing(T_world_target) - self._home_bearing
        home[0] += self.base_turn * np.arctan2(np.sin(turn), np.cos(turn))
        spread = np.random.default_rng(0).normal(scale=0.5, size=(count - 1, len(home)))
        # Rotating the wrist by pi gives the same approach: seed both branches.
        wrist = home.copy()
        wrist[-1] += np.pi / 2 if wrist[-1] < 0 else -np.pi / 2
        return [home, wrist, *(home + offset for offset in spread)][:count]

    def self_motion(
        self, q: Float[np.ndarray, "n"], step: float = 0.35, count: int = 3
    ) -> Iterator[Float[np.ndarray, "n"]]:
        """Yield other postures [rad] with the TCP where ``q`` has it, those next to ``q`` first.

        They lie on the curve of self-motion through ``q``, whose tangent is the null space of the Jacobian of
        the TCP. An arm of up to six joints has none.

        Args:
            q: (n,) joint positions in [rad].
            step: distance between two of them, as that of the joint that moves most, in [rad].
            count: largest number on each side of ``q``.
        """
        if len(q) <= _TASK_DIMENSIONS:
            return
        T, tangent = self.forward(q), self._self_motion_tangent(q)
        sides = [(q, tangent), (q, -tangent)]
        for _ in range(count):
            going_on = []
            for before, direction in sides:
                start = before + step * direction / np.abs(direction).max()
                result = self.inverse(T, [start], name="the pose of a posture")
                moved = np.abs(result.q - before).max()
                if result.converged and 0.5 * step < moved < 2.0 * step:
                    yield result.q
                    ahead = self._self_motion_tangent(result.q)
                    going_on.append((result.q, ahead * np.sign(ahead @ direction)))
            sides = going_on

    def _self_motion_tangent(self, q: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return a unit vector of the null space of the Jacobian of the TCP."""
        self.forward(q)
        mujoco.mj_comPos(self._model, self._data)
        jacobian = np.zeros((_TASK_DIMENSIONS, self._model.nv))
        mujoco.mj_jacSite(self._model, self._data, jacobian[:3], jacobian[3:], self._site_ids["tcp"])
        return np.linalg.svd(jacobian)[2][-1]

    def _descend_once(self, T_world_target: np.ndarray, seed: np.ndarray, frame: Frame) -> IkResult:
        """Return what ``_descend`` returns, from memory if it was asked for the same before."""
        key = (frame, T_world_target.tobytes(), seed.tobytes())
        result = self._descents.get(key)
        if result is None:
            result = self._descend(mink.SE3.from_matrix(T_world_target), seed, frame)
            if len(self._descents) >= _REMEMBERED:
                self._descents.clear()
            self._descents[key] = result
        return result

    def _descend(self, target: mink.SE3, seed: np.ndarray, frame: Frame) -> IkResult:
        """Iterate differential IK from one seed until the tolerances hold or progress stops."""
        c = self.config
        margin = c.limit_margin
        q = np.zeros(self._model.nq)
        q[self._address] = np.clip(seed, self.lower + margin, self.upper - margin)
        configuration = self._configuration
        configuration.update(q)
        task = self._tasks[frame]
        task.set_target(target)
        self._posture.set_target(q)
        best, stalled, iteration = np.inf, 0, 0
        position_error = rotation_error = np.inf
        for iteration in range(c.max_iterations + 1):
            error = task.compute_error(configuration)
            position_error = float(np.linalg.norm(error[:3]))
            rotation_error = float(np.linalg.norm(error[3:]))
            if position_error <= c.position_tolerance and rotation_error <= c.rotation_tolerance:
                q_arm = configuration.q[self._address].copy()
                return IkResult(q_arm, "converged", position_error, rotation_error, iteration)
            total = position_error + 0.1 * rotation_error
            stalled = 0 if total < 0.9 * best else stalled + 1
            best = min(best, total)
            if stalled > c.patience or iteration == c.max_iterations:
                break
            try:
                velocity = mink.solve_ik(
                    configuration,
                    [task, self._posture],
                    c.dt,
                    "daqp",
                    damping=c.damping,
                    limits=[self._limit],
                )
            except mink.NoSolutionFound:
                break
            configuration.integrate_inplace(velocity, c.dt)
        q_arm = configuration.q[self._address].copy()
        return IkResult(q_arm, "not_converged", position_error, rotation_error, iteration)


def _error(result: IkResult) -> float:
    return result.position_error + 0.1 * result.rotation_error


def _check_target(T: np.ndarray, name: str) -> None:
    """Raise for poses that the solver would silently turn into NaN velocities."""
    T = np.asarray(T)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise ManipulationError(f"the pose of {name} must be a finite 4x4 matrix, got {T.tolist()}")
    rotation = T[:3, :3]
    error = np.abs(rotation @ rotation.T - _IDENTITY)  # np.allclose takes a tenth of the time of a solution
    if error.max() > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise ManipulationError(f"the pose of {name} is not a rigid motion: its rotation is not orthonormal")
