"""One line, an exit code and a log file for each exception that ends a command."""

from __future__ import annotations

import errno
import os
import resource
import sys
import tempfile
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from app.errors import AppError, StalledError
from perception.errors import install_hint

TASK_FAILED, BAD_INPUT = 1, 2
LONGEST = 500  # characters of a line
LOG_FILE = "error.log"

# Optional extra that provides a library.
_SIMULATOR = ("mujoco", "mjviser", "mink", "daqp", "ruckig", "coacd")
EXTRA_OF: dict[str, str] = dict.fromkeys(_SIMULATOR, "sim")
EXTRA_OF |= {
    "tensorboard": "train",
    "transformers": "hf",
    "gymnasium": "gym",
    "pyarrow": "collect",
    "zmq": "remote",
}

# Classes of errors that mean invalid usage or input, and that mean a failed task, by the module that defines
# them.
_INPUT_ERRORS = {
    "perception.errors": "PerceptionError",
    "sim_assets.errors": "SimAssetsError",
    "manipulation.errors": "PlanningError",
    "manipulation.remote.calibration": "CalibrationError",
}
_TASK_ERRORS = {"manipulation.errors": "ManipulationError"}
_GL_FILES = ("gl_context.py", "osmesa.py", "glfw.py", "egl.py", "camera.py")
_REMEDIES = {
    errno.ENOSPC: "free some space or give --out on another disk",
    errno.EDQUOT: "free some space or give --out on another disk",
    errno.EFBIG: "raise the limit on the size of files (ulimit -f)",
    errno.EROFS: "give --out in a folder that can be written",
    errno.EACCES: "check the permissions of the path",
    errno.EPERM: "check the permissions of the path",
    errno.ENAMETOOLONG: "give a shorter path",
    errno.EMFILE: "raise the limit on open files (ulimit -n)",
}


@dataclass(frozen=True)
class Failure:
    """How a command ends after an exception.

    Attributes:
        message: What is wrong and what to do, in one line.
        code: Exit code.
        expected: Whether the message is all that there is to know; if not, the traceback belongs into a log.
    """

    message: str
    code: int = BAD_INPUT
    expected: bool = True


def failure_of(error: Exception, command: str) -> Failure:
    """Describe an exception that ended a command."""
    if isinstance(error, StalledError):
        return Failure(str(error), TASK_FAILED, expected=False)
    if isinstance(error, (AppError, *_loaded(_INPUT_ERRORS))):
        return Failure(str(error))
    if isinstance(error, _loaded(_TASK_ERRORS)):
        return Failure(str(error), TASK_FAILED)
    if isinstance(error, ModuleNotFoundError):
        extra = EXTRA_OF.get((error.name or "").split(".")[0])
        if extra is not None:
            return Failure(f"{command} needs {error.name}: {install_hint(extra)}")
    if _is_out_of_memory(error):
        return Failure(f"{command} ran out of memory: give it smaller input or more memory", expected=False)
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes) else ""
        remedy = _REMEDIES.get(error.errno)
        return Failure(f"{where}{error.strerror}" + (f"; {remedy}" if remedy else ""), expected=False)
    backend = os.environ.get("MUJOCO_GL")
    if backend and _is_from_graphics(error):
        name = "MUJOCO_EGL_DEVICE_ID" if "MUJOCO_EGL_DEVICE_ID" in str(error) else "MUJOCO_GL"
        setting = f"{name}={os.environ[name]}"
        return Failure(f"{setting} does not work on this machine ({error}): unset it", expected=False)
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    address_space, _ = resource.getrlimit(resource.RLIMIT_AS)
    if address_space != resource.RLIM_INFINITY:  # libraries report its exhaustion in many ways
        allowed = f"the {address_space / 2**20:.0f} MB of address space that it was given (ulimit -v)"
        return Failure(f"{command} failed ({what}), perhaps for {allowed}: allow more", expected=False)
    return Failure(f"{command} failed unexpectedly: {what}", TASK_FAILED, expected=False)


def write_log(error: BaseException, folder: Path | None) -> Path | None:
    """Write the traceback to a run folder, or to a temporary file; return the file, None if neither works."""
    text = "".join(traceback.format_exception(error))
    if folder is not None:
        try:
            (folder / LOG_FILE).write_text(text, encoding="utf-8", errors="backslashreplace")
            return folder / LOG_FILE
        except OSError:
            pass
    try:
        handle, name = tempfile.mkstemp(prefix="nodeslam-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
        return Path(name)
    except OSError:
        return None


def one_line(text: str) -> str:
    """Return the text as one line of printable characters; a long one is shortened in the middle."""
    line = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode()
        for c in " ".join(text.split())
    )
    if len(line) <= LONGEST:
        return line
    half = (LONGEST - 5) // 2
    return f"{line[:half]} ... {line[-half:]}"


def _loaded(errors: Mapping[str, str]) -> tuple[type[Exception], ...]:
    """Return those of the exception types whose module is loaded: others cannot have been raised."""
    return tuple(
        getattr(sys.modules[module], name) for module, name in errors.items() if module in sys.modules
    )


def _is_from_graphics(error: Exception) -> bool:
    """Return whether the exception arose while OpenGL was loaded or a context was made."""
    frames = traceback.extract_tb(error.__traceback__)[-6:]
    return any(Path(f.filename).name in _GL_FILES or "/OpenGL/" in f.filename for f in frames)


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an allocation failed: of Python and numpy, of torch, or of the loader of libraries."""
    text = str(error)
    texts = {
        RuntimeError: ("allocate memory", "out of memory"),
        ImportError: ("failed to map segment", "allocate"),
    }
    return isinstance(error, MemoryError) or any(
        isinstance(error, kind) and any(part in text for part in parts) for kind, parts in texts.items()
    )
