"""Chooses the OpenGL backend before MuJoCo is imported; sim_assets takes ``mujoco`` from here alone.

MuJoCo reads ``MUJOCO_GL`` while it is being imported and, where nothing is set, asks for a window. Without a
screen that ends the process, so the choice is made here, once: what the user set, else EGL, else OSMesa.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import os
import sys
import warnings
from typing import TYPE_CHECKING, Any, TypeAlias

from sim_assets.errors import SimAssetsError

logger = logging.getLogger(__name__)

_EGL_PLATFORM_DEVICE = 0x313F  # EGL_EXT_platform_device: a display without a screen
_INSTALL = "install Mesa's software renderer: apt-get install libegl1 libgl1 libosmesa6"


class GraphicsError(SimAssetsError, RuntimeError):
    """This machine cannot render; the message says what to install."""


def egl_works() -> bool:
    """Whether some EGL device can be initialised, asked of the library itself, without a context."""
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query_address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    display_address = egl.eglGetProcAddress(b"eglGetPlatformDisplayEXT")
    if not query_address or not display_address:
        return False
    query = ctypes.CFUNCTYPE(
        ctypes.c_uint, ctypes.c_int, ctypes.POINTER(ctypes.c_void_p), ctypes.POINTER(ctypes.c_int)
    )(query_address)
    get_display = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint, ctypes.c_void_p, ctypes.c_void_p)(
        display_address
    )
    devices, count = (ctypes.c_void_p * 16)(), ctypes.c_int()
    if not query(16, devices, ctypes.byref(count)):
        return False
    egl.eglInitialize.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
    displays = (get_display(_EGL_PLATFORM_DEVICE, device, None) for device in devices[: count.value])
    return any(display and egl.eglInitialize(display, None, None) for display in displays)


def osmesa_works() -> bool:
    """Whether the OSMesa library can be loaded."""
    for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def choose_backend() -> str:
    """Set ``MUJOCO_GL`` unless the user did, and return it; '' where nothing can render (physics works)."""
    chosen = os.environ.get("MUJOCO_GL", "")
    if not chosen and sys.platform.startswith("linux"):
        chosen = "egl" if egl_works() else "osmesa" if osmesa_works() else ""
        os.environ["MUJOCO_GL"] = chosen or "disable"
        for name in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
            if name in sys.modules:  # somebody (mink, say) imported mujoco first: let it choose again
                importlib.reload(sys.modules[name])
    return chosen


def require_rendering() -> None:
    """Raise GraphicsError where no image can be made."""
    if os.environ.get("MUJOCO_GL") in ("disable", "disabled", "off", "false", "0"):
        raise GraphicsError(f"no OpenGL for rendering without a screen (neither EGL nor OSMesa): {_INSTALL}")


choose_backend()
warnings.filterwarnings("ignore", module=r"glfw")  # the exception that follows has the reason

# After the choice, on purpose. MuJoCo's extension modules come without type stubs: for checkers they are Any.
mujoco: Any = importlib.import_module("mujoco")
# Its own handler appends to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(lambda message: logger.warning("MuJoCo: %s", message))

if TYPE_CHECKING:
    MjSpec: TypeAlias = Any
    MjsBody: TypeAlias = Any
    MjModel: TypeAlias = Any
    MjData: TypeAlias = Any
else:
    MjSpec, MjsBody, MjModel, MjData = mujoco.MjSpec, mujoco.MjsBody, mujoco.MjModel, mujoco.MjData


def gl_context(width: int, height: int) -> Any:
    """A new OpenGL context with the chosen backend."""
    require_rendering()
    return importlib.import_module("mujoco.gl_context").GLContext(width, height)


__all__ = [
    "GraphicsError",
    "MjData",
    "MjModel",
    "MjSpec",
    "MjsBody",
    "choose_backend",
    "egl_works",
    "gl_context",
    "mujoco",
    "osmesa_works",
    "require_rendering",
]
