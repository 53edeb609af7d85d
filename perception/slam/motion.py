"""Constant-velocity Kalman filter of the camera's pose and velocity.

The true pose is T Exp(xi) and the true velocity v + u, with Gaussian errors (xi, u). White-noise acceleration
of spectral density q^2 makes the velocity a random walk: over a time s,

    xi <- xi + s u + N(0, q^2 s^3 / 3),   u <- u + N(0, q^2 s),   covariance of both q^2 s^2 / 2.

Tracking supplies the measurement: a pose and its information matrix. Directions without information keep the
predicted motion, with growing covariance.

The filter takes the errors of successive frames as independent, but an error of the map is common to all
frames that show it. So a second covariance of the pose is propagated by covariance intersection, which holds
for any correlation (Julier and Uhlmann, "A non-divergent estimation algorithm in the presence of unknown
correlations", 1997). It does not enter the estimate; it tells when the map in view does not determine the
camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, invert, se3_exp, se3_log

_POSE, _VELOCITY = slice(0, 6), slice(6, 12)
_SHARES = np.linspace(0.02, 1.0, 25)  # weights of the prior that covariance intersection chooses from


@dataclass(frozen=True)
class CameraMotionConfig:
    """Process noise and initial uncertainty; pairs are (rotation, translation) along each axis.

    Attributes:
        velocity_random_walk: Growth of the velocity's standard deviation over one second, in rad/s and m/s;
            it grows with the square root of time.
        velocity_sigma: Standard deviation of an unknown velocity, in rad/s and m/s.
        pose_sigma: Standard deviation of the first pose, in radians and metres.
        max_periods: Longest time over which the velocity is extrapolated, in frame periods.
    """

    velocity_random_walk: tuple[float, float] = (0.9, 0.55)
    velocity_sigma: tuple[float, float] = (2.0, 1.2)
    pose_sigma: tuple[float, float] = (1e-4, 1e-4)
    max_periods: float = 5.0


@dataclass(frozen=True)
class CameraMotion:
    """State of the filter at one time.

    Attributes:
        time: Time of the state, in seconds.
        T_world_camera: Estimated pose.
        velocity: Twist (rotation, translation) in the camera frame, in rad/s and m/s.
        covariance: Covariance of the errors of pose and velocity, each (rotation, translation) in the camera
            frame.
        correlated_covariance: Covariance of the pose's error for any correlation between frames.
        period: Time between the first two frames, in seconds; 0 before the second frame.
    """

    time: float
    T_world_camera: Float[np.ndarray, "4 4"]
    velocity: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "12 12"]
    correlated_covariance: Float[np.ndarray, "6 6"]
    period: float = 0.0

    @staticmethod
    def with_unknown_velocity(
        time: float,
        T_world_camera: Float[np.ndarray, "4 4"],
        config: CameraMotionConfig,
        pose_covariance: Float[np.ndarray, "6 6"] | None = None,
        period: float = 0.0,
    ) -> CameraMotion:
        """Return a state with zero mean velocity; the pose covariance defaults to the config's."""
        if pose_covariance is None:
            pose_covariance = np.diag(_variances(config.pose_sigma))
        P = np.zeros((12, 12))
        P[_POSE, _POSE] = pose_covariance
        P[_VELOCITY, _VELOCITY] = np.diag(_variances(config.velocity_sigma))
        return CameraMotion(time, np.array(T_world_camera), np.zeros(6), P, P[_POSE, _POSE], period)

    @property
    def pose_covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose (rotation, translation) in the camera frame."""
        return self.covariance[_POSE, _POSE]

    @property
    def position_std(self) -> float:
        """Standard deviation of the camera position along its least certain direction, in metres."""
        return _position_std(self.pose_covariance)

    @property
    def correlated_position_std(self) -> float:
        """The same for any correlation between the errors of successive frames."""
        return _position_std(self.correlated_covariance)

    def predict(self, time: float, config: CameraMotionConfig) -> CameraMotion:
        """Return the state at a later time (Kalman prediction)."""
        elapsed = max(time - self.time, 0.0)
        longest = config.max_periods * self.period if self.period else elapsed
        twist = self.velocity * min(elapsed, longest)
        F = np.eye(12)
        F[_POSE, _POSE] = adjoint(se3_exp(-twist))
        F[_POSE, _VELOCITY] = elapsed * np.eye(6)
        growth = np.array([[elapsed**3 / 3, elapsed**2 / 2], [elapsed**2 / 2, elapsed]])
        noise = np.kron(growth, np.diag(_variances(config.velocity_random_walk)))
        P = F @ self.covariance @ F.T + noise
        A = F[_POSE, _POSE]
        added = _positive(P[_POSE, _POSE] - A @ self.pose_covariance @ A.T)  # by velocity and its noise
        correlated = A @ self.correlated_covariance @ A.T + added
        T = self.T_world_camera @ se3_exp(twist)
        return CameraMotion(time, T, self.velocity, P, correlated, self.period or elapsed)

    def update(
        self, T_world_camera: Float[np.ndarray, "4 4"], information: Float[np.ndarray, "6 6"]
    ) -> CameraMotion:
        """Return the state after a pose measurement (Kalman update).

        Args:
            T_world_camera: Maximum a posteriori pose: tracking already combines frame and prediction.
            information: Information matrix of the frame alone on the pose, in the camera frame.
        """
        P = self.covariance
        prior = P[_POSE, _POSE]
        posterior = np.linalg.inv(np.linalg.inv(prior) + information)
        gain = np.linalg.solve(prior, P[_POSE, _VELOCITY]).T  # regression of the velocity on the pose
        step = se3_log(invert(self.T_world_camera) @ T_world_camera)
        after = np.empty((12, 12))
        after[_POSE, _POSE] = posterior
        after[_VELOCITY, _POSE] = gain @ posterior
        after[_POSE, _VELOCITY] = after[_VELOCITY, _POSE].T
        after[_VELOCITY, _VELOCITY] = P[_VELOCITY, _VELOCITY] - gain @ (prior - posterior) @ gain.T
        return replace(
            self,
            T_world_camera=T_world_camera,
            velocity=self.velocity + gain @ step,
            covariance=after,
            correlated_covariance=covariance_intersection(self.correlated_covariance, information),
        )

    def transformed(self, T_new_old: Float[np.ndarray, "4 4"]) -> CameraMotion:
        """Return the same state after a correction of the world frame, as bundle adjustment makes."""
        return replace(self, T_world_camera=T_new_old @ self.T_world_camera)


def adjoint(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """Return the adjoint: T Exp(xi) T^-1 = Exp(adjoint(T) xi), with twists xi = (rotation, translation)."""
    R = T[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = hat(T[:3, 3]) @ R
    return out


def covariance_intersection(
    covariance: Float[np.ndarray, "6 6"], information: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """Fuse a pose with a measurement whose errors may be correlated: (w P^-1 + (1 - w) information)^-1.

    The weight w is that of the least position uncertainty along its least certain direction.
    """
    w = _SHARES[:, None, None]
    fused = np.linalg.inv(w * np.linalg.inv(covariance) + (1 - w) * information)
    return fused[np.argmin(np.linalg.eigvalsh(fused[:, 3:, 3:])[:, -1])]


def _position_std(pose_covariance: Float[np.ndarray, "6 6"]) -> float:
    """Return the standard deviation of the position along its least certain direction, in metres."""
    return float(np.sqrt(max(np.linalg.eigvalsh(pose_covariance[3:, 3:])[-1], 0.0)))


def _positive(matrix: Float[np.ndarray, "6 6"]) -> Float[np.ndarray, "6 6"]:
    """Return a symmetric matrix with its negative eigenvalues set to 0."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _variances(sigmas: tuple[float, float]) -> Float[np.ndarray, "6"]:
    """Return the variances along the six axes."""
    return np.repeat(np.square(sigmas), 3)
