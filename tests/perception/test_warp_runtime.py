"""Warp's start: quiet, once, from whichever thread comes first."""

import subprocess
import sys
from pathlib import Path

_THREADS = """
import threading, sys
import numpy as np
from perception.rendering.kernel import pad_kernel
from perception.rendering.renderer import ShapeGrid

grid = np.full((32, 32, 32), 0.5, np.float32)
barrier, sums = threading.Barrier(6), []

def work():
    barrier.wait()
    sums.append(float(ShapeGrid.upload(grid).occupancy.numpy().sum()))

threads = [threading.Thread(target=work) for _ in range(6)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(sums == [0.5 * 32**3] * 6, len(pad_kernel.module.execs))
sys.stderr.write("still here\\n")
"""

_WORDS = """
import os, sys
import warp as wp
from perception import warp_runtime

def init():
    os.write(2, b"Warp CUDA warning: nothing found\\n")
    os.write(2, b"another's words\\n")

wp.init = init
warp_runtime._has_driver = lambda: False
warp_runtime.start_warp()
warp_runtime.start_warp()
"""


def _run(script: str) -> subprocess.CompletedProcess[str]:
    root = Path(__file__).parents[2]
    return subprocess.run(
        [sys.executable, "-c", script], cwd=root, capture_output=True, text=True, timeout=120
    )


def test_threads_may_race_for_the_start():
    done = _run(_THREADS)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "True 1\n" and done.stderr == "still here\n"


def test_only_the_words_of_warp_are_kept_from_standard_error():
    done = _run(_WORDS)
    assert done.returncode == 0 and done.stderr == "another's words\n"
