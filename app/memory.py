"""Memory that a finished episode or job has freed, returned to the system.

The C library keeps freed blocks for later allocations. PyTorch, MuJoCo and Warp allocate blocks of all sizes
from several threads, and the memory of a process that ran many episodes grew by half within ten of them.
Threads also get heaps of their own (arenas), each of which keeps what its largest moment needed.
"""

from __future__ import annotations

import ctypes
import gc
import sys

MAX_ARENAS = 2
_M_ARENA_MAX = -8  # malloc.h


def limit_arenas() -> None:
    """Let all threads share two heaps, where the C library has a function for it (glibc).

    To be called before many threads have started: only later ones share the heaps that there are.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # musl has none
        if mallopt is not None:
            mallopt(_M_ARENA_MAX, MAX_ARENAS)


def release_freed_memory() -> None:
    """Return freed memory to the system, where the C library has a function for it (glibc)."""
    gc.collect()
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # musl has none
        if trim is not None:
            trim(ctypes.c_size_t(0))
