"""Warp, started once for the process and safely from any thread; launches and arrays go through here.

Warp's own start is not made for threads, nor is the first use of a kernel, which compiles it; both happen
here under one lock. On machines without an NVIDIA driver its native part writes a warning to standard error,
where a command's one clear line belongs: the words go to the log instead.
"""

from __future__ import annotations

import ctypes
import logging
import os
import tempfile
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

logger = logging.getLogger(__name__)

wp.config.log_level = wp.LOG_ERROR  # no banner on standard output

_lock = threading.RLock()
_started = False
_loaded: set[tuple[str, str]] = set()  # (module, device) whose kernels are ready


def start_warp() -> None:
    """Initialises Warp; calls after the first do nothing."""
    global _started
    if _started:
        return
    with _lock:
        if not _started:
            if _has_driver():
                wp.init()
            else:
                _start_quietly()
            _started = True


def launch(
    kernel: Any, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any], device: str
) -> None:
    """``wp.launch``, after making sure that Warp runs and the kernel's module is compiled."""
    key = (kernel.module.name, device)
    if key not in _loaded:
        with _lock:
            start_warp()
            kernel.module.load(wp.get_device(device))
            _loaded.add(key)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)


def zeros(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """``wp.zeros``."""
    return wp.zeros(shape, dtype=dtype, device=device)


def empty(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """``wp.empty``."""
    return wp.empty(shape, dtype=dtype, device=device)


def to_device(values: np.ndarray, dtype: Any, device: str) -> wp.array:
    """An array of float or int32 scalars, vectors or matrices on the device; shares memory where it can."""
    scalar = np.int32 if dtype is wp.int32 else np.float32
    return wp.from_numpy(np.ascontiguousarray(values, scalar), dtype=dtype, device=device)


def _has_driver() -> bool:
    for name in ("libcuda.so", "libcuda.so.1", "nvcuda.dll"):
        try:
            ctypes.CDLL(name)
        except OSError:
            continue
        return True
    return False


def _start_quietly() -> None:
    """Starts Warp with what its native part says kept apart; others' words of that moment are passed on."""
    with tempfile.TemporaryFile() as words:
        kept = os.dup(2)
        os.dup2(words.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        words.seek(0)
        for line in words:
            if line.startswith(b"Warp"):
                logger.debug("%s", line.decode(errors="replace").strip())
            else:
                os.write(2, line)
