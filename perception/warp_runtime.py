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
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
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
    _load(kernel, device)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)


def record(
    kernel: Any, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any], device: str
) -> Any:
    """The launch, not done yet: its ``launch()`` may be called again and again, at a tenth of the cost.

    Not from several threads at a time.
    """
    _load(kernel, device)
    return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)


def in_parallel(jobs: Sequence[Callable[[], None]]) -> None:
    """Does all jobs, launches on the CPU for instance: those let go of Python's lock."""
    others = [_pool().submit(job) for job in jobs[1:]]
    for job in jobs[:1]:
        job()
    for other in others:
        other.result()


def run_recorded(recorded: Sequence[Any], changed: Mapping[int, Any] | None = None) -> None:
    """Does recorded launches side by side, with other arguments at some positions; these stay."""

    def run_one(one: Any) -> None:
        for position, value in (changed or {}).items():
            one.set_param_at_index(position, value)
        one.launch()

    in_parallel([partial(run_one, one) for one in recorded])


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="warp")


def _load(kernel: Any, device: str) -> None:
    """Warp and the kernel's module, ready to be used from any thread.

    It is loaded for the block size that launches take. They would load it themselves, two threads at once two
    copies, of which the first goes away with its recorded launches still pointing into it.
    """
    key = (kernel.module.name, device)
    if key not in _loaded:
        with _lock:
            start_warp()
            there = wp.get_device(device)
            kernel.module.load(there, 1 if there.is_cpu else 256)
            _loaded.add(key)


def zeros(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """``wp.zeros``."""
    return wp.zeros(shape, dtype=dtype, device=device)


def empty(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """``wp.empty``."""
    return wp.empty(shape, dtype=dtype, device=device)


def to_device(values: np.ndarray, dtype: Any, device: str) -> wp.array:
    """An array of float, int32 or uint8 scalars, vectors, matrices on the device; shares memory if it can."""
    scalar = {wp.int32: np.int32, wp.vec3i: np.int32, wp.uint8: np.uint8}.get(dtype, np.float32)
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
