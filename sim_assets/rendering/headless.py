"""Selection of the OpenGL backend before MuJoCo is imported; sim_assets imports ``mujoco`` from here only.

MuJoCo reads ``MUJOCO_GL`` on import and, if it is unset, requires a window system, without which the process
ends. The backend is therefore selected here: the user's setting, else EGL, else OSMesa.
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

_EGL_PLATFORM_DEVICE = 0x313F  # EGL_EXT_platform_device: headless display
_INSTALL = "install Mesa's software renderer: apt-get install libegl1 libgl1 libosmesa6"


class GraphicsError(SimAssetsError, RuntimeError):
    """This machine cannot render; the message names the packages to install."""


def egl_works() -> bool:
    """Return whether an EGL device can be initialised, without creating a context."""
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
    """Return whether the OSMesa library can be loaded."""
    for name in ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def choose_backend() -> str:
    """Set ``MUJOCO_GL`` unless the user did, and return it; '' without a backend (physics still works)."""
    chosen = os.environ.get("MUJOCO_GL", "")
    if not chosen and sys.platform.startswith("linux"):
        chosen = "egl" if egl_works() else "osmesa" if osmesa_works() else ""
        os.environ["MUJOCO_GL"] = chosen or "disable"
        for name in ("mujoco.rendering.classic.gl_context", "mujoco.gl_context"):
            if name in sys.modules:  # mujoco was imported before (by mink, for example): select again
                importlib.reload(sys.modules[name])
    return chosen


def require_rendering() -> None:
    """Raise GraphicsError if no backend can render."""
    if os.environ.get("MUJOCO_GL") in ("disable", "disabled", "off", "false", "0"):
        raise GraphicsError(f"no OpenGL for rendering without a screen (neither EGL nor OSMesa): {_INSTALL}")


choose_backend()
warnings.filterwarnings("ignore", module=r"glfw")  # the exception that follows gives the reason

# Imported after the selection. MuJoCo's extension modules have no type stubs: type checkers see Any.
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
    """Return a new OpenGL context of the selected backend."""
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
