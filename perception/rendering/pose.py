"""The object's 9-DoF pose: how cameras see the canonical cube, and how the depth changes with the pose.

A pose changes locally: R <- R exp(omega), t <- t + v (world), s <- s * exp(sigma). Its nine parameters are
ordered (omega [rad], object frame; v [m], world frame; sigma, log scale along the object's axes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from perception.geometry import so3_exp
from perception.rendering.renderer import Rendering

POSE_SIZE = 9


@dataclass(frozen=True)
class ObjectPose:
    """p_world = rotation @ (scale * p_canonical) + translation.

    Attributes:
        rotation: (3, 3), object to world.
        translation: (3,) of the object's origin, the grid's centre, in the world [m].
        scale: (3,) metres per canonical unit along the object's axes.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: Float[np.ndarray, "3"]

    @property
    def T_world_object(self) -> Float[np.ndarray, "4 4"]:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.rotation, self.translation
        return T

    @staticmethod
    def of(T_world_object: Float[np.ndarray, "4 4"], scale: Float[np.ndarray, "3"]) -> ObjectPose:
        return ObjectPose(np.array(T_world_object[:3, :3]), np.array(T_world_object[:3, 3]), np.array(scale))

    def moved(self, step: Float[np.ndarray, "9"]) -> ObjectPose:
        """The pose after a step (omega, v, sigma); its rotation stays orthonormal."""
        rotation = self.rotation @ so3_exp(step[:3])
        u, _, vt = np.linalg.svd(rotation)
        return ObjectPose(u @ vt, self.translation + step[3:6], self.scale * np.exp(step[6:]))


def canonical_from_camera(
    pose: ObjectPose, Ts_world_camera: Float[np.ndarray, "v 4 4"]
) -> Float[np.ndarray, "v 3 4"]:
    """Affine maps from each camera's frame into the canonical cube: S^-1 R^T (T_world_camera p - t)."""
    A = np.empty((len(Ts_world_camera), 3, 4))
    to_canonical = pose.rotation.T / pose.scale[:, None]
    A[:, :, :3] = to_canonical @ Ts_world_camera[:, :3, :3]
    A[:, :, 3] = (Ts_world_camera[:, :3, 3] - pose.translation) @ to_canonical.T
    return A


def pose_jacobian(
    pose: ObjectPose,
    A_canonical_camera: Float[np.ndarray, "v 3 4"],
    directions: Float[np.ndarray, "n 3"],
    view: Int[np.ndarray, "n"],
    rendering: Rendering,
) -> Float[np.ndarray, "n 9"]:
    """Derivative of the rendered depth by (omega, v, sigma).

    With a sample at q = a + delta b in the object's frame [m], g = S^-1 q in canonical coordinates:
    dg/dv = -S^-1 R^T, dg/domega = S^-1 hat(q), dg/dsigma = -diag(g); two sums along the ray carry them over.
    """
    if rendering.sum_gradient is None or rendering.sum_depth_gradient is None:
        raise ValueError("the rendering has no gradients: call render(..., gradients=True)")
    n, g1, g2 = len(directions), rendering.sum_gradient, rendering.sum_depth_gradient
    # All of it is linear in g1 and in the products of g2 with the pixel's direction (whose z is 1).
    features = np.empty((n, 12), dtype=np.float32)
    features[:, :3] = g1
    np.multiply(g2[:, :, None], directions[:, None, :], out=features[:, 3:].reshape(n, 3, 3))
    out = np.empty((n, POSE_SIZE), dtype=np.float32)
    for index, maps in enumerate(_sum_maps(pose, A_canonical_camera)):
        rows = view == index
        out[rows] = features[rows] @ maps
    return out


def _sum_maps(
    pose: ObjectPose, A_canonical_camera: Float[np.ndarray, "v 3 4"]
) -> Float[np.ndarray, "v 12 9"]:
    """For each view the matrix from (g1, g2 x direction) to the derivative by the pose."""
    n = len(A_canonical_camera)
    maps = np.zeros((n, 12, POSE_SIZE))
    maps[:, :3, 3:6] = -pose.rotation.T / pose.scale[:, None]
    A = A_canonical_camera * pose.scale[:, None]  # to the object's frame, in [m]
    by_point = _BY_POINT / pose.scale[:, None, None]  # (axis, coordinate of q, parameter)
    maps[:, :3] += np.einsum("vc,acp->vap", A[:, :, 3], by_point)
    maps[:, 3:] = np.einsum("vcd,acp->vadp", A[:, :, :3], by_point).reshape(n, 9, POSE_SIZE)
    return maps.astype(np.float32)


def _rows_by_point() -> Float[np.ndarray, "3 3 9"]:
    """[hat(q), 0, -diag(q)] by its row and the coordinate of q: linear in q."""
    rows = np.zeros((3, 3, POSE_SIZE))
    for axis in range(3):
        rows[axis, :, :3] = np.cross(np.eye(3)[axis], np.eye(3))
        rows[axis, axis, 6 + axis] = -1.0
    return rows


_BY_POINT = _rows_by_point()
