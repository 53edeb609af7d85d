"""Threads for frames and objects, and one for each numerical library where those already occupy the cores."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

from threadpoolctl import ThreadpoolController


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run the BLAS of numpy and scipy, and torch if it is loaded, on one thread each.

    Nested thread pools on the same cores are up to 15 times slower: hundreds of small arrays cost less than
    starting threads for them.
    """
    with single_threaded_torch(), _pools().limit(limits=1, user_api="blas"):
        yield


@contextmanager
def single_threaded_torch() -> Iterator[None]:
    """Run torch on one thread; without effect where it is not loaded."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def worker_pool(workers: int | None = None) -> ThreadPoolExecutor:
    """Return a pool of ``workers`` threads; None for one for each core."""
    return ThreadPoolExecutor(workers or os.cpu_count() or 1)


@cache
def _pools() -> ThreadpoolController:
    """Return the thread pools of this process; finding them takes milliseconds."""
    return ThreadpoolController()
