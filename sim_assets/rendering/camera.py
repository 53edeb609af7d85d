"""Registered colour, metric depth and geometry-id images from MuJoCo's classic renderer.

MuJoCo's cameras look along -z with y up; everything outside this file uses OpenCV's axes (x right, y down,
z forward). Pixel centres are at integers, so the principal point of a W x H image is ((W-1)/2, (H-1)/2).
"""

from __future__ import annotations

import atexit
import functools
import weakref
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from perception.types import CameraIntrinsics
from sim_assets.rendering.headless import MjData, MjModel, gl_context, mujoco

OPENCV_FROM_MUJOCO = np.diag([1.0, -1.0, -1.0])  # rotation between the two conventions; its own inverse
MAX_DEPTH = 10.0  # [m], range limit of the depth camera


def intrinsics_of(width: int, height: int, fovy: float) -> CameraIntrinsics:
    """Return the pinhole parameters of a MuJoCo camera with a vertical field of view ``fovy`` in [deg]."""
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    return CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def camera_pose(data: MjData, camera: str) -> Float[np.ndarray, "4 4"]:
    """Return T_world_camera of a named MuJoCo camera, in OpenCV's axes."""
    view = data.camera(camera)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = view.xmat.reshape(3, 3) @ OPENCV_FROM_MUJOCO
    T_world_camera[:3, 3] = view.xpos
    return T_world_camera


def look_at(
    position: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"], roll: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """Return T_world_camera (OpenCV) at ``position`` toward ``target``, upright but for ``roll`` [rad]."""
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
    """MuJoCo's classic renderer for one model, at any image size, in one GL context opened on first use.

    Depth and geom ids come from one pass without antialiasing, so no pixel mixes two surfaces. Contexts
    left open are freed at interpreter exit, before MuJoCo's own modules are unloaded.
    """

    def __init__(self, model: MjModel, draft: bool = False) -> None:
        """Create the renderer. ``draft``: no multisampling, coarser shadows, under half the cost."""
        self._model, self._draft = model, draft
        self._gl: Any = None
        self._context: Any = None
        self._size = (0, 0)
        self._scene: Any = mujoco.MjvScene(model, maxgeom=4000)
        self._option = _visible_option()
        _open.add(self)

    def color(
        self,
        data: MjData,
        camera: str,
        width: int,
        height: int,
        shadows: bool = True,
        reflections: bool = True,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the colour image; shadows and reflections each about double its cost."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = reflections
        image = np.empty((height, width, 3), dtype=np.uint8)
        self._draw(data, camera, width, height)
        mujoco.mjr_readPixels(image, None, mujoco.MjrRect(0, 0, width, height), self._context)
        return np.flipud(image).copy()

    def depth_and_ids(
        self, data: MjData, camera: str, width: int, height: int
    ) -> tuple[Float[np.ndarray, "h w"], Int[np.ndarray, "h w"]]:
        """Return depth and geom id of the nearest surface at each pixel.

        Returns:
            Depth along the optical axis in [m], without noise, 0 where no surface is within MAX_DEPTH; and
            the id of the geom, -1 for none.
        """
        flags = self._scene.flags.copy()
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        code = np.empty((height, width, 3), dtype=np.uint8)
        buffer = np.empty((height, width), dtype=np.float32)
        self._draw(data, camera, width, height)
        mujoco.mjr_readPixels(code, buffer, mujoco.MjrRect(0, 0, width, height), self._context)
        np.copyto(self._scene.flags, flags)
        return np.flipud(self._metric(buffer)).copy(), np.flipud(self._geom_ids(code)).copy()

    def upload_texture(self, texture: int) -> None:
        """Upload a texture edited in place to the GL context, if one is open."""
        if self._gl is not None:
            self._gl.make_current()
            mujoco.mjr_uploadTexture(self._model, self._context, texture)

    def close(self) -> None:
        """Free the GL context; a later image opens a new one."""
        if self._gl is not None:
            if self._context is not None:
                self._gl.make_current()
                self._context.free()
            self._gl.free()
        self._gl = self._context = None

    def _draw(self, data: MjData, camera: str, width: int, height: int) -> None:
        self._prepare(width, height)
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = self._model.camera(camera).id
        category = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(self._model, data, self._option, None, view, category, self._scene)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, width, height), self._scene, self._context)

    def _prepare(self, width: int, height: int) -> None:
        """Return a current GL context with an offscreen buffer of this size."""
        if self._gl is None:
            self._gl = gl_context(width, height)
            _close_at_exit()
            self._gl.make_current()
            quality = self._model.vis.quality
            usual = quality.offsamples, quality.shadowsize
            if self._draft:
                quality.offsamples, quality.shadowsize = 0, 1024
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
            quality.offsamples, quality.shadowsize = usual
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
            self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
            self._size = (0, 0)
        self._gl.make_current()
        if self._size != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, self._context)
            self._size = (width, height)

    def _metric(self, buffer: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Convert a depth buffer (1 at the near plane, 0 at the far one, linear in inverse depth) to [m]."""
        extent = self._model.stat.extent
        near, far = self._model.vis.map.znear * extent, self._model.vis.map.zfar * extent
        inverse = 1 / far + buffer.astype(np.float64) * (1 / near - 1 / far)
        return np.where(inverse > 1 / MAX_DEPTH, 1 / inverse, 0).astype(np.float32)

    def _geom_ids(self, code: UInt8[np.ndarray, "h w 3"]) -> Int[np.ndarray, "h w"]:
        """Decode the segmentation colours: 1 + index in the scene in three bytes, 0 for the background."""
        index = code.astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], dtype=np.int32)
        geom = int(mujoco.mjtObj.mjOBJ_GEOM)
        ids = np.full(self._scene.ngeom + 1, -1, dtype=np.int32)
        for shown in self._scene.geoms[: self._scene.ngeom]:
            if shown.objtype == geom and shown.segid >= 0:
                ids[shown.segid + 1] = shown.objid
        return ids[index]


def _visible_option() -> Any:
    """Return the scene option that hides collision shapes, sites and tendons."""
    option = mujoco.MjvOption()
    option.geomgroup[3:] = 0
    option.sitegroup[:] = 0
    option.tendongroup[:] = 0
    return option


_open: weakref.WeakSet[OffscreenRenderer] = weakref.WeakSet()


@functools.cache
def _close_at_exit() -> None:
    """Close all contexts at exit. Registered after MuJoCo's EGL handler: exit handlers run in reverse."""
    atexit.register(_close_all)


def _close_all() -> None:
    for renderer in list(_open):
        renderer.close()
