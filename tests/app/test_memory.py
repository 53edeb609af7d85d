"""Freed memory goes back to the system."""

import ctypes
import sys

import pytest

from app.evaluation.jobs import resident_memory
from app.memory import release_freed_memory

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


def test_other_systems_are_left_alone(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: pytest.fail("no library is needed"))
    release_freed_memory()
