"""The support plane as a landmark: residuals of measured plane points with respect to the camera pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.inference.levenberg_marquardt import Evaluation
from perception.types import SupportPlane


@dataclass(frozen=True)
class PlaneNoise:
    """Weights of the plane residuals.

    Attributes:
        sigma: Standard deviation of a plane point's height, in metres.
        huber: Residuals beyond this many sigma are weighted linearly (Huber).
        data_weight: Factor on all weights, for the correlation between neighbouring pixels.
    """

    sigma: float
    huber: float
    data_weight: float


def evaluate_plane(
    T_world_camera: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    plane: SupportPlane,
    noise: PlaneNoise,
) -> Evaluation:
    """Return the heights of plane points and their derivative with respect to the camera pose.

    The height of a point p is n . (R p + t) - offset. The camera moves locally by xi = (rotation,
    translation), so with n in the camera frame the derivative is (p x n, n).

    Args:
        T_world_camera: Pose of the camera.
        points: Measured points of the plane in the camera frame, in metres.
        plane: Support plane in the world frame.
        noise: Weights.
    """
    normal = T_world_camera[:3, :3].T @ plane.normal
    residual = points @ normal + T_world_camera[:3, 3] @ plane.normal - plane.offset
    jacobian = np.concatenate([np.cross(points, normal), np.broadcast_to(normal, points.shape)], axis=1)
    robust = np.minimum(1.0, noise.huber * noise.sigma / np.maximum(np.abs(residual), 1e-9))
    return Evaluation(residual, jacobian, noise.data_weight * robust / noise.sigma**2)
