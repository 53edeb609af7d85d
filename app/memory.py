"""Memory that a finished episode or job has freed, returned to the system.

The C library keeps freed blocks for later allocations. PyTorch, MuJoCo and Warp allocate blocks of all sizes
from several threads, and the memory of a process that ran many episodes grew by half within ten of them.
"""

from __future__ import annotations

import ctypes
import gc
import sys


def release_freed_memory() -> None:
    """Return freed memory to the system, where the C library has a function for it (glibc)."""
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(ctypes.c_size_t(0))
