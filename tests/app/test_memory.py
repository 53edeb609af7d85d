"""Freed memory goes back to the system."""

import ctypes
import subprocess
import sys

import pytest

from app.jobs import resident_memory
from app.memory import MAX_ARENAS, limit_arenas, release_freed_memory

BLOCK, BLOCKS = 2**16, 1600  # below the size from which the C library asks the system for each block


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc")
def test_blocks_between_used_ones_are_returned():
    blocks = [bytearray(b"x" * BLOCK) for _ in range(BLOCKS)]
    before = resident_memory()
    kept = blocks[::8]  # without them the heap would shrink by itself
    del blocks
    release_freed_memory()
    after = resident_memory()
    assert before is not None and after is not None
    assert before - after > 0.7 * BLOCK * (BLOCKS - len(kept))


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="the C library is not glibc")
@pytest.mark.parametrize("limited", [False, True])
def test_threads_share_two_heaps(limited):
    threads = 6
    code = f"""
import ctypes, threading
from app.memory import limit_arenas
if {limited}:
    limit_arenas()
started = threading.Barrier({threads})
def allocate():
    started.wait()
    block = bytearray(10**5)
    started.wait()
running = [threading.Thread(target=allocate) for _ in range({threads})]
for thread in running:
    thread.start()
for thread in running:
    thread.join()
ctypes.CDLL(None).malloc_stats()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert (done.stderr.count("Arena ") <= MAX_ARENAS) == limited


def test_other_systems_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: pytest.fail("no library is needed"))
    release_freed_memory()
    limit_arenas()
