"""Registered colour, metric depth and geometry-id images from MuJoCo's classic renderer.

MuJoCo's cameras look along -z with y up; everything outside this file uses OpenCV's axes (x right, y down,
z forward). Pixel centres are at integers, so the principal point of a W x H image is ((W-1)/2, (H-1)/2).
"""

from __future__ import annotations

import atexit
import weakref
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from perception.types import CameraIntrinsics
from sim_assets.headless import MjData, MjModel, mujoco, require_rendering

OPENCV_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])  # the one flip between the two conventions; its own inverse
MAX_DEPTH = 10.0  # [m], beyond it nothing is measured


def intrinsics_of(width: int, height: int, fovy: float) -> CameraIntrinsics:
    """Pinhole parameters of a MuJoCo camera with a vertical field of view ``fovy`` in [deg]."""
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def camera_pose(data: MjData, camera: str) -> Float[np.ndarray, "4 4"]:
    """T_world_camera of a named MuJoCo camera, in OpenCV's axes."""
    view = data.camera(camera)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = view.xmat.reshape(3, 3) @ OPENCV_FROM_MUJOCO
    T_world_camera[:3, 3] = view.xpos
    return T_world_camera


def look_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """T_world_camera (OpenCV) at ``position``, looking at ``target``, upright but for ``roll`` in [rad]."""
    forward = np.asarray(target, dtype=np.float64) - position
    forward /= np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([c * right + s * down, c * down - s * right, forward], axis=1)
    T_world_camera[:3, 3] = position
    return T_world_camera


class OffscreenRenderer:
    """Renders one model, at any image size; keeps a GL context per size until ``close``.

    Contexts that nobody closed are freed when the interpreter ends, before MuJoCo's own modules go.
    """

    def __init__(self, model: MjModel) -> None:
        require_rendering()
        self._model = model
        self._renderers: dict[tuple[int, int], Any] = {}
        _open.add(self)

    def of_size(self, width: int, height: int) -> Any:
        """The classic ``mujoco.Renderer`` for one image size, created on first use."""
        if (width, height) not in self._renderers:
            self._renderers[width, height] = mujoco.Renderer(self._model, height, width)
        return self._renderers[width, height]

    def color(self, data: MjData, camera: str, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
        """Colour image, with shadows and reflections."""
        renderer = self.of_size(width, height)
        renderer.update_scene(data, camera, _visible())
        return renderer.render().copy()

    def depth(self, data: MjData, camera: str, width: int, height: int) -> Float[np.ndarray, "h w"]:
        """Depth along the optical axis in [m], without noise; 0 where there is nothing within MAX_DEPTH."""
        renderer = self.of_size(width, height)
        renderer.update_scene(data, camera, _visible())
        renderer.enable_depth_rendering()
        try:
            depth = renderer.render().copy()
        finally:
            renderer.disable_depth_rendering()
        depth[depth > MAX_DEPTH] = 0
        return depth

    def geometry_ids(self, data: MjData, camera: str, width: int, height: int) -> Int[np.ndarray, "h w"]:
        """The id of the geom that each pixel shows, -1 for the sky."""
        renderer = self.of_size(width, height)
        renderer.update_scene(data, camera, _visible())
        renderer.enable_segmentation_rendering()
        try:
            ids, kinds = np.moveaxis(renderer.render(), -1, 0)
        finally:
            renderer.disable_segmentation_rendering()
        return np.where(kinds == int(mujoco.mjtObj.mjOBJ_GEOM), ids, -1).astype(np.int32)

    def close(self) -> None:
        """Free the GL contexts; a later image opens new ones."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()


def _visible() -> Any:
    """Scene option that shows what a camera would see: no collision shapes, sites or tendons."""
    option = mujoco.MjvOption()
    option.geomgroup[3:] = 0
    option.sitegroup[:] = 0
    option.tendongroup[:] = 0
    return option


_open: weakref.WeakSet[OffscreenRenderer] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()
