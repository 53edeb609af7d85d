"""The object's 9-DoF pose: how cameras see the canonical cube, and how the depth changes with the pose.

A pose changes locally: R <- R exp(omega), t <- t + v (world), s <- s * exp(sigma). Its nine parameters are
ordered (omega [rad], object frame; v [m], world frame; sigma, log scale along the object's axes).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.geometry import hat, so3_exp
from perception.rendering.renderer import RayBundle, Rendering

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
        """Return the pose after a step (omega, v, sigma); its rotation stays orthonormal."""
        rotation = self.rotation @ so3_exp(step[:3])
        u, _, vt = np.linalg.svd(rotation)
        return ObjectPose(u @ vt, self.translation + step[3:6], self.scale * np.exp(step[6:]))

    def turned(self, turn: Float[np.ndarray, "3"], about: Float[np.ndarray, "3"]) -> ObjectPose:
        """Return the pose after a turn [rad], a rotation vector, about a point [m]; both in its own frame."""
        rotation = self.moved(np.concatenate([turn, np.zeros(6)])).rotation
        return ObjectPose(rotation, self.translation + (self.rotation - rotation) @ about, self.scale)


def object_by_camera(pose: ObjectPose, T_world_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6 6"]:
    """The motion of an object that looks the same as a small motion Exp(xi) of the camera on its right.

    Rows: the object's turn (own frame) and move (world); columns: xi = (rotation, translation), camera frame.
    """
    R, c = T_world_camera[:3, :3], T_world_camera[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = -pose.rotation.T @ R
    out[3:, :3] = hat(pose.translation - c) @ R
    out[3:, 3:] = -R
    return out


def canonical_from_camera(
    pose: ObjectPose, Ts_world_camera: Float[np.ndarray, "v 4 4"]
) -> Float[np.ndarray, "v 3 4"]:
    """Return maps from each camera's frame to the canonical cube: S^-1 R^T (T_world_camera p - t)."""
    A = np.empty((len(Ts_world_camera), 3, 4))
    to_canonical = pose.rotation.T / pose.scale[:, None]
    A[:, :, :3] = to_canonical @ Ts_world_camera[:, :3, :3]
    A[:, :, 3] = (Ts_world_camera[:, :3, 3] - pose.translation) @ to_canonical.T
    return A


def pose_jacobian(
    pose: ObjectPose,
    A_canonical_camera: Float[np.ndarray, "v 3 4"],
    rays: RayBundle,
    rendering: Rendering,
    out: Float[np.ndarray, "n 9"] | None = None,
) -> Float[np.ndarray, "n 9"]:
    """Return the derivative of the rendered depth with respect to (omega, v, sigma), by the chain rule.

    Args:
        pose: Pose of the object.
        A_canonical_camera: Camera maps of the rendering.
        rays: Rendered rays.
        rendering: Rendering with gradients.
        out: Output array; None for a new one.
    """
    if rendering.d_map is None:
        raise ValueError("the rendering has no gradients: call render(..., gradients=True)")
    if out is None:
        out = np.empty((len(rays.directions), POSE_SIZE), np.float32)
    for own, by_pose in zip(rays.view_slices, map_jacobian(pose, A_canonical_camera), strict=True):
        np.matmul(rendering.d_map[own], by_pose, out=out[own])
    return out


def map_jacobian(
    pose: ObjectPose, A_canonical_camera: Float[np.ndarray, "v 3 4"]
) -> Float[np.ndarray, "v 12 9"]:
    """Return the derivative of the maps, column by column, with respect to (omega, v, sigma).

    For a column a of A: da/domega = S^-1 hat(S a), da/dsigma = -diag(a); only the last, the camera's centre,
    moves with the translation: da/dv = -S^-1 R^T.
    """
    columns = np.moveaxis(A_canonical_camera, 2, 1)
    maps = np.zeros((*columns.shape, POSE_SIZE))
    in_object = columns * pose.scale  # [m], or [m] for each metre of depth
    for axis, (one, two) in enumerate(((1, 2), (2, 0), (0, 1))):  # rows of hat: (0, -z, y), (z, 0, -x), ...
        maps[..., axis, one] = -in_object[..., two] / pose.scale[axis]
        maps[..., axis, two] = in_object[..., one] / pose.scale[axis]
        maps[..., axis, 6 + axis] = -columns[..., axis]
    maps[:, 3, :, 3:6] = -pose.rotation.T / pose.scale[:, None]
    return maps.reshape(len(maps), 12, POSE_SIZE).astype(np.float32)
