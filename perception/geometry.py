"""Rotations and rigid motions: exponential and logarithm maps in float64.

Tangent vectors of SE(3) are ordered (rotation [rad], translation [m]). Formulas: Sola, Deray, Atchuthan, "A
micro Lie theory for state estimation in robotics", 2018, appendices B and D.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_SMALL = 1e-4  # [rad] angle below which series are used; their truncation error is below 1e-16


def hat(v: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return the matrix of the cross product: hat(v) @ p = v x p."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def so3_exp(omega: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by |omega| radians about omega (Rodrigues)."""
    angle = float(np.linalg.norm(omega))
    a, b, _ = _coefficients(angle)
    W = hat(omega)
    return np.eye(3) + a * W + b * W @ W


def so3_log(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Return the rotation vector of a rotation matrix, of length at most pi."""
    axis2 = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2  # sin(angle) * axis
    sine, cosine = float(np.linalg.norm(axis2)), (np.trace(R) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if angle < _SMALL:
        return axis2
    if sine > 1e-6:
        return axis2 * (angle / sine)
    # Near pi the antisymmetric part vanishes; the symmetric part is 2 axis axis^T - 1.
    columns = ((R + R.T) / 2 + np.eye(3)) / 2
    axis = columns[:, int(np.argmax(np.diag(columns)))]
    axis = axis / np.linalg.norm(axis)
    return angle * axis * (1.0 if axis @ axis2 >= 0 else -1.0)


def se3_exp(xi: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Return the rigid motion of a tangent vector (rotation, translation)."""
    omega, v = np.asarray(xi[:3], np.float64), np.asarray(xi[3:], np.float64)
    _, b, c = _coefficients(float(np.linalg.norm(omega)))
    W = hat(omega)
    T = np.eye(4)
    T[:3, :3] = so3_exp(omega)
    T[:3, 3] = (np.eye(3) + b * W + c * W @ W) @ v
    return T


def se3_log(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    """Return the tangent vector (rotation, translation) of a rigid motion."""
    omega = so3_log(T[:3, :3])
    _, b, c = _coefficients(float(np.linalg.norm(omega)))
    W = hat(omega)
    V = np.eye(3) + b * W + c * W @ W
    return np.concatenate([omega, np.linalg.solve(V, T[:3, 3])])


def invert(T: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Return the inverse of a rigid motion."""
    out = np.eye(4)
    out[:3, :3] = T[:3, :3].T
    out[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return out


def rigid(R: Float[np.ndarray, "3 3"], t: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the rigid motion of a rotation and a translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def pose_from_yaw(yaw: float, position: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Return the rotation by ``yaw`` radians about z followed by the translation to ``position``."""
    c, s = np.cos(yaw), np.sin(yaw)
    T = np.eye(4)
    T[:2, :2] = ((c, -s), (s, c))
    T[:3, 3] = position
    return T


def nearest_yaw(T: Float[np.ndarray, "4 4"]) -> float:
    """Return the angle [rad] of the rotation about z that is nearest to the pose's, in the Frobenius norm."""
    return float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))


def wrapped_angle(angle: float) -> float:
    """Return the equal angle [rad] in [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def levelled(T: Float[np.ndarray, "4 4"], height: float) -> Float[np.ndarray, "4 4"]:
    """Return a pose without its tilt, with the same x and y and its origin at a height [m]."""
    return pose_from_yaw(nearest_yaw(T), np.array([T[0, 3], T[1, 3], height]))


def transform_points(
    T_target_source: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Return points of the source frame in the target frame."""
    return points @ T_target_source[:3, :3].T + T_target_source[:3, 3]


def upright_rotation(normal: Float[np.ndarray, "3"], yaw: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation by ``yaw`` radians about z followed by the shortest one from z to the normal."""
    z, n = np.array([0.0, 0.0, 1.0]), normal / np.linalg.norm(normal)
    axis, cosine = np.cross(z, n), float(n[2])
    sine = float(np.linalg.norm(axis))
    tilt = (
        axis * (np.arctan2(sine, cosine) / sine) if sine > 1e-12 else np.array([np.pi, 0, 0]) * (cosine < 0)
    )
    return so3_exp(tilt) @ so3_exp(yaw * z)


def yaw_of(R: Float[np.ndarray, "3 3"]) -> float:
    """Return the direction of the rotated x axis about z, in radians."""
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _coefficients(angle: float) -> tuple[float, float, float]:
    """Return sin(x)/x, (1 - cos x)/x^2 and (x - sin x)/x^3."""
    if angle < _SMALL:
        return 1 - angle**2 / 6, 0.5 - angle**2 / 24, 1 / 6 - angle**2 / 120
    return (
        np.sin(angle) / angle,
        (1 - np.cos(angle)) / angle**2,
        (angle - np.sin(angle)) / angle**3,
    )
