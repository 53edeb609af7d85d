"""Threads of the numerical libraries inside and outside of ``single_threaded``."""

import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from perception.threads import single_threaded, worker_pool


def blas_threads():
    return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    with threadpool_limits(limits=2, user_api="blas"):
        yield
    torch.set_num_threads(before)


def test_torch_and_blas_run_on_one_thread_and_then_as_before(two_threads) -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    before = blas_threads()
    with pytest.raises(RuntimeError), single_threaded():
        assert torch.get_num_threads() == 1
        assert blas_threads() and set(blas_threads().values()) == {1}
        raise RuntimeError  # an error must not leave the process on one thread
    assert torch.get_num_threads() == 2
    assert blas_threads() == before


def test_a_pool_has_one_thread_for_each_core_unless_told(monkeypatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    for workers, expected in ((None, 3), (2, 2)):
        with worker_pool(workers) as pool:
            threads = list(pool.map(lambda _: (time.sleep(0.02), threading.get_ident())[1], range(12)))
        assert len(set(threads)) == expected


def test_torch_is_not_loaded_for_its_threads() -> None:
    code = "import sys; from perception.threads import single_threaded\nwith single_threaded(): pass\n"
    code += "assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
