"""Colour images from MuJoCo's physically based renderer, Filament.

It uses Vulkan, here always a software driver, and terminates the process without one; a child process
therefore probes it first. Its depth is not metric: depth and ids come from the classic renderer.
"""

from __future__ import annotations

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

import numpy as np
from jaxtyping import UInt8

from sim_assets.processes import probe
from sim_assets.rendering.headless import GraphicsError, MjData, MjModel

INSTALL = "install Vulkan's loader and Mesa's software driver: apt-get install libvulkan1 mesa-vulkan-drivers"
_PROBE = """
from sim_assets.rendering.filament import FilamentRenderer
from sim_assets.rendering.headless import mujoco
parts = '<light pos="0 0 2"/><camera name="c" pos="0 0 1"/><geom size=".1"/>'
model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{parts}</worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
image = FilamentRenderer(model, probed=True).color(data, "c", 64, 48)
raise SystemExit(0 if image.any() else 3)
"""
_PROBE_SECONDS = 120
_NEAR, _FAR = 0.05, 20.0  # [m]


@functools.cache
def filament_fault() -> str:
    """Return why Filament cannot render on this machine, probed in a child process; '' if it can."""
    try:
        ended = probe(_PROBE, _PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return f"no image within {_PROBE_SECONDS} s"
    if ended.returncode == 0:
        return ""
    if ended.returncode < 0:
        return "the probing process was terminated: no usable Vulkan driver"
    return (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1][:100]


def require_filament() -> None:
    """Raise GraphicsError if Filament cannot render."""
    fault = filament_fault()
    if fault:
        raise GraphicsError(f"the filament renderer does not work here ({fault}); {INSTALL}")


class FilamentRenderer:
    """Filament renderer for one model. ``load`` uploads the textures; every image updates the poses.

    Geoms visible at loading are rendered regardless of their group: geoms hidden later must be moved out of
    every camera's view.
    """

    def __init__(self, model: MjModel, probed: bool = False) -> None:
        """Create the renderer; ``probed`` skips the probe.

        Raises:
            GraphicsError: Filament cannot render on this machine.
        """
        if not probed:
            require_filament()
        importlib.import_module("mujoco.experimental.studio.window")  # registers the materials
        self._api: Any = importlib.import_module("mujoco.mjrf")
        self._model = model
        self._context = _context(self._api)
        self._target = self._context.create_render_target(
            self._api.RenderTargetConfig(color_format=self._api.PixelFormat.PIXEL_FORMAT_RGB8)
        )
        self._parts: Any = None
        self.load()

    def load(self) -> None:
        """Upload the model's meshes, textures and lights again, after they were edited in place."""
        self._parts = None
        resources = self._api.ModelResources(self._context, self._model)
        scene = self._context.create_scene(self._api.SceneParams())
        scene.configure_from_model(self._model)
        lights = self._api.ModelLights(scene, resources)
        self._parts = resources, scene, lights, self._api.ModelRenderables(scene, resources)

    def color(self, data: MjData, camera: str, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
        """Return the image of a camera of the model."""
        _, scene, lights, renderables = self._parts
        lights.update(data)
        renderables.update(data)
        self._target.resize(width, height)
        image = np.empty((height, width, 3), np.uint8)
        read = self._api.ReadRequest(target=self._target)
        read.set_buffer(image)
        request = self._api.RenderRequest()
        request.scene, request.target = scene, self._target
        request.camera = self._camera(data, camera)
        view = request.viewport
        view.left, view.bottom, view.width, view.height = 0, 0, width, height
        request.draw_mode = self._api.DrawMode.DRAW_MODE_DEFAULT
        request.post_processing = request.reflections = request.shadows = True
        self._context.wait_for_frame(self._context.render([request], [read]))
        return image

    def close(self) -> None:
        """Release the model; the context, slow to create, is kept for the next renderer."""
        self._parts = None

    def _camera(self, data: MjData, camera: str) -> Any:
        view = data.camera(camera)
        axes = view.xmat.reshape(3, 3)
        top = _NEAR * np.tan(np.radians(self._model.camera(camera).fovy[0]) / 2)
        return self._api.Camera(
            pos=view.xpos, forward=-axes[:, 2], up=axes[:, 1], frustum_bottom=-top, frustum_top=top,
            frustum_near=_NEAR, frustum_far=_FAR,
        )  # fmt: skip


@functools.cache
def _context(api: Any) -> Any:
    """Return the only context of this process. The engine's log goes to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        return api.Context(
            api.ContextConfig(graphics_api=api.GraphicsApi.GRAPHICS_API_VULKAN, software_rendering=True)
        )
    finally:
        os.dup2(kept, 1)
        os.close(kept)
