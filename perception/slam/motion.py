"""How the camera moves, and how sure its pose is: a Kalman filter on pose and velocity.

The true pose is T Exp(xi), the true velocity v + u, with the small errors (xi, u) Gaussian. Between frames
the velocity wanders as white acceleration makes it, so over a time s, with wander q,

    xi <- xi + s u + N(0, q^2 s^3 / 3),   u <- u + N(0, q^2 s),   covariance of both q^2 s^2 / 2;

tracking then says what a frame knows of the pose. What no frame knows goes on as the camera was moving, in
growing doubt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, invert, se3_exp, se3_log

_POSE, _VELOCITY = slice(0, 6), slice(6, 12)


@dataclass(frozen=True)
class MotionConfig:
    """What is known of a camera's motion beforehand; rotation first, then translation.

    Attributes:
        wander: of the velocity in a second, along each axis, growing with the root of time [rad/s], [m/s].
        velocity: the same of a motion that nothing is known of [rad/s], [m/s].
        start: of the first pose [rad], [m].
        longest: a motion is carried on over at most so many usual periods.
    """

    wander: tuple[float, float] = (0.9, 0.55)
    velocity: tuple[float, float] = (2.0, 1.2)
    start: tuple[float, float] = (1e-4, 1e-4)
    longest: float = 5.0


@dataclass(frozen=True)
class Motion:
    """The camera's pose and velocity at a time, with what is not known of them.

    Attributes:
        time: of the pose [s].
        T_world_camera: the pose.
        velocity: twist in the camera's frame [rad/s], [m/s].
        covariance: of the errors (rotation, translation, and their velocities), in the camera's frame.
        period: usual time between frames [s]; 0 before the second.
    """

    time: float
    T_world_camera: Float[np.ndarray, "4 4"]
    velocity: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "12 12"]
    period: float = 0.0

    @staticmethod
    def at(
        time: float,
        T_world_camera: Float[np.ndarray, "4 4"],
        config: MotionConfig,
        covariance: Float[np.ndarray, "6 6"] | None = None,
        period: float = 0.0,
    ) -> Motion:
        """A camera whose velocity is not known; its pose is, by default, as well as the first one."""
        P = np.zeros((12, 12))
        P[_POSE, _POSE] = np.diag(_each(config.start)) if covariance is None else covariance
        P[_VELOCITY, _VELOCITY] = np.diag(_each(config.velocity))
        return Motion(time, np.array(T_world_camera), np.zeros(6), P, period)

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        return self.covariance[_POSE, _POSE]

    @property
    def spread(self) -> float:
        """Standard deviation of the place in the direction that is known least [m]."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1], 0.0)))

    def predicted(self, time: float, config: MotionConfig) -> Motion:
        """Carried on to another time."""
        elapsed = max(time - self.time, 0.0)
        longest = config.longest * self.period if self.period else elapsed
        carried = self.velocity * min(elapsed, longest)
        F = np.eye(12)
        F[_POSE, _POSE] = adjoint(se3_exp(-carried))
        F[_POSE, _VELOCITY] = elapsed * np.eye(6)
        growth = np.array([[elapsed**3 / 3, elapsed**2 / 2], [elapsed**2 / 2, elapsed]])
        P = F @ self.covariance @ F.T + np.kron(growth, np.diag(_each(config.wander)))
        return Motion(time, self.T_world_camera @ se3_exp(carried), self.velocity, P, self.period or elapsed)

    def told(self, T_world_camera: Float[np.ndarray, "4 4"], information: Float[np.ndarray, "6 6"]) -> Motion:
        """After a frame: the pose that fits it and this motion best, and what the frame alone knew."""
        P = self.covariance
        prior = P[_POSE, _POSE]
        posterior = np.linalg.inv(np.linalg.inv(prior) + information)
        gain = np.linalg.solve(prior, P[_POSE, _VELOCITY]).T  # of the velocity on the pose
        step = se3_log(invert(self.T_world_camera) @ T_world_camera)
        after = np.empty((12, 12))
        after[_POSE, _POSE] = posterior
        after[_VELOCITY, _POSE] = gain @ posterior
        after[_POSE, _VELOCITY] = after[_VELOCITY, _POSE].T
        after[_VELOCITY, _VELOCITY] = P[_VELOCITY, _VELOCITY] - gain @ (prior - posterior) @ gain.T
        return replace(
            self, T_world_camera=T_world_camera, velocity=self.velocity + gain @ step, covariance=after
        )

    def moved(self, T_new_old: Float[np.ndarray, "4 4"]) -> Motion:
        """The same motion after the world has been set right by so much."""
        return replace(self, T_world_camera=T_new_old @ self.T_world_camera)


def adjoint(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Takes twists (rotation, translation) along: T Exp(xi) T^-1 = Exp(adjoint(T) xi)."""
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(T[:3, 3]) @ R
    return out


def _each(sigmas: tuple[float, float]) -> Float[np.ndarray, "6"]:
    """Variances along the six axes."""
    return np.repeat(np.square(sigmas), 3)
