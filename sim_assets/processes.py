"""Child processes that end with the process that started them, whatever ended it."""

from __future__ import annotations

import ctypes
import functools
import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_C_LIBRARY = ctypes.CDLL(None)  # loaded here: a process that has just been forked must not load libraries


def kill_with(parent: int) -> None:
    """Let the kernel end this process when the process that started it has ended; on Linux only."""
    if sys.platform == "linux":
        _C_LIBRARY.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it ended before the call
            os._exit(1)


def probe(program: str, seconds: float) -> subprocess.CompletedProcess[str]:
    """Run a Python program that may terminate its process, such as a first use of OpenGL.

    Args:
        program: Source code.
        seconds: Time limit [s].

    Raises:
        subprocess.TimeoutExpired: It takes longer; it is ended.
    """
    return subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=seconds,
        preexec_fn=functools.partial(kill_with, os.getpid()),  # before it executes anything
    )  # fmt: skip
