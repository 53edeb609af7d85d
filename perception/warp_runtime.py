"""Thread-safe initialisation of Warp, kernel launches and arrays.

Neither Warp's initialisation nor the first use of a kernel, which compiles it, is thread-safe; both happen
here under one lock. Without an NVIDIA driver Warp's native library prints a warning to standard error, which
is redirected to the log.
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
_loaded: set[tuple[str, str]] = set()  # (module, device) with loaded kernels


def start_warp() -> None:
    """Initialise Warp; later calls have no effect."""
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


def warp_has_cuda() -> bool:
    """Return whether Warp can use a CUDA device."""
    start_warp()
    return wp.is_cuda_available()


def launch(
    kernel: Any, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any], device: str
) -> None:
    """Call ``wp.launch`` after Warp is initialised and the kernel's module is loaded."""
    _load(kernel, device)
    wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device)


def record(
    kernel: Any, dim: int | tuple[int, ...], inputs: Sequence[Any], outputs: Sequence[Any], device: str
) -> Any:
    """Record a launch without executing it; its ``launch()`` costs a tenth of ``wp.launch``.

    A recorded launch must not be used from several threads at a time.
    """
    _load(kernel, device)
    return wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=device, record_cmd=True)


def in_parallel(jobs: Sequence[Callable[[], None]]) -> None:
    """Run all jobs in parallel threads; for jobs that release the GIL, such as launches on the CPU."""
    others = [_pool().submit(job) for job in jobs[1:]]
    for job in jobs[:1]:
        job()
    for other in others:
        other.result()


def run_recorded(recorded: Sequence[Any], changed: Mapping[int, Any] | None = None) -> None:
    """Run recorded launches in parallel, after setting the arguments at the given positions permanently."""

    def run(job: Any) -> None:
        for position, value in (changed or {}).items():
            job.set_param_at_index(position, value)
        job.launch()

    in_parallel([partial(run, job) for job in recorded])


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="warp")


def _load(kernel: Any, device: str) -> None:
    """Initialise Warp and load the kernel's module for the block size of launches.

    Concurrent launches would each load a copy, and recorded launches would keep pointing into a freed one.
    """
    key = (kernel.module.name, device)
    if key not in _loaded:
        with _lock:
            start_warp()
            there = wp.get_device(device)
            kernel.module.load(there, 1 if there.is_cpu else 256)
            _loaded.add(key)


def zeros(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """Call ``wp.zeros``."""
    return wp.zeros(shape, dtype=dtype, device=device)


def empty(shape: int | tuple[int, ...], dtype: Any, device: str) -> wp.array:
    """Call ``wp.empty``."""
    return wp.empty(shape, dtype=dtype, device=device)


def to_device(values: np.ndarray, dtype: Any, device: str) -> wp.array:
    """Return a Warp array of float, int32 or uint8 scalars, vectors or matrices; a view if possible."""
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
    """Initialise Warp and move its messages from standard error to the log; other output is passed on."""
    with tempfile.TemporaryFile() as output:
        kept = os.dup(2)
        os.dup2(output.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        output.seek(0)
        for line in output:
            if line.startswith(b"Warp"):
                logger.debug("%s", line.decode(errors="replace").strip())
            else:
                os.write(2, line)
