"""The arm in its own camera images: where it is, from its joint positions alone, and images without it.

Rays are cast at a coarse grid of pixels against the arm's collision geoms, without OpenGL, and the result is
grown by a pixel of that grid, since collision shapes are approximations.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from manipulation.arm_model import collision_spec, joint_addresses, mujoco, site_index
from manipulation.robot import ArmDescription
from perception.types import CameraIntrinsics, RgbdFrame

STEP = 8  # pixels of an image per ray
BEHIND = 0.03  # [m] that a measurement may lie behind the rendered arm and still belong to it
HOUSING = 0.03  # [m] from the camera: what is nearer is its housing, through which it sees
_CUTOFF = 3.0  # [m]
_IGNORED = 5  # geom group of the housing


class SelfView:
    """Renders the depth of an arm in its wrist camera.

    Args:
        arm: the arm.
    """

    def __init__(self, arm: ArmDescription) -> None:
        self._model = collision_spec(arm.mjcf).compile()
        self._data = mujoco.MjData(self._model)
        self._joints = joint_addresses(self._model, arm.joint_names)
        self._fingers = joint_addresses(self._model, arm.fingers.joint_names)
        self._camera = site_index(self._model, arm.camera_site)
        self._arm = arm

    def depth(
        self, q: Float[np.ndarray, "n"], width: float, intrinsics: CameraIntrinsics
    ) -> Float[np.ndarray, "r c"]:
        """Return the depth of the arm in [m] at every ``STEP``-th pixel; infinite where it is not.

        Args:
            q: (n,) joint positions in [rad].
            width: opening between the pads in [m].
            intrinsics: of the camera.
        """
        data, model = self._data, self._model
        data.qpos[self._joints] = q
        data.qpos[self._fingers] = self._arm.fingers.at(width)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        v, u = np.mgrid[STEP // 2 : intrinsics.height : STEP, STEP // 2 : intrinsics.width : STEP]
        x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
        rays = np.stack([x, y, np.ones(u.shape)], axis=-1).reshape(-1, 3)  # of depth 1
        rays = rays @ data.site_xmat[self._camera].reshape(3, 3).T
        distance, geoms = self._cast(rays)
        housing = np.unique(geoms[(geoms >= 0) & (distance < HOUSING)])
        if len(housing):
            model.geom_group[housing] = _IGNORED
            distance, geoms = self._cast(rays)
        return np.where(geoms >= 0, distance, np.inf).reshape(u.shape)

    def _cast(self, rays: Float[np.ndarray, "k 3"]) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of the first hits in multiples of the rays, and their geoms, -1 for none."""
        distance, geoms = np.full(len(rays), -1.0), np.full(len(rays), -1, dtype=np.int32)
        groups = np.array([group != _IGNORED for group in range(6)], dtype=np.uint8)
        origin, flat = self._data.site_xpos[self._camera].copy(), rays.ravel()
        mujoco.mj_multiRay(
            self._model, self._data, origin, flat, groups, 1, -1, geoms, distance, None, len(rays), _CUTOFF
        )
        return distance, geoms

    def without_arm(self, frame: RgbdFrame, q: Float[np.ndarray, "n"], width: float) -> RgbdFrame:
        """Return the frame without the depth of the pixels that show the arm; the same frame if none do."""
        coarse = self.depth(q, width, frame.intrinsics)
        if not np.isfinite(coarse).any():
            return frame
        near = cv2.erode(np.where(np.isfinite(coarse), coarse, 1e6).astype(np.float32), np.ones((3, 3)))
        size = (frame.intrinsics.width, frame.intrinsics.height)
        limit = cv2.resize(near, size, interpolation=cv2.INTER_NEAREST)
        farthest = cv2.dilate(np.where(np.isfinite(coarse), coarse, 0).astype(np.float32), np.ones((3, 3)))
        limit = np.where(limit < 1e6, cv2.resize(farthest, size, interpolation=cv2.INTER_NEAREST), -np.inf)
        shown = (frame.depth > 0) & (frame.depth < limit + BEHIND)
        return replace(frame, depth=np.where(shown, 0, frame.depth).astype(frame.depth.dtype))


def fixed_bounds(arm: ArmDescription) -> Float[np.ndarray, "k 2 3"]:
    """Return the box, grown by ``BEHIND``, around the links that do not move; none if they have no shape.

    Smallest and largest corner in the world frame, in metres.
    """
    model = collision_spec(arm.mjcf).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)
    if not len(geoms):
        return np.zeros((0, 2, 3))
    R = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centre, half = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    middle = data.geom_xpos[geoms] + np.einsum("gij,gj->gi", R, centre)
    reach = np.einsum("gij,gj->gi", np.abs(R), half) + BEHIND
    return np.stack([(middle - reach).min(axis=0), (middle + reach).max(axis=0)])[None]
