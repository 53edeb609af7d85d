"""Processes of a training: messages, errors, deaths, interrupts."""

import os
import signal
import time

import numpy as np
import pytest
import torch

from app.errors import UsageError
from app.training.processes import check_processes, run_on_ranks
from perception.errors import PerceptionError


def act(what: str, ranks, report) -> None:
    """Do something in the second process that leaves the first alone in a collective operation."""
    report(ranks.rank, os.getpid(), signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    ranks.total(torch.ones(1))  # both have reported
    if ranks.rank == 1:
        if what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if what == "diverge":
            raise PerceptionError("training diverged")
        if what == "fail":
            raise ZeroDivisionError("of all things")
        time.sleep(60)
    ranks.total(torch.ones(1))


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("what", "error", "message"),
    [
        ("die", PerceptionError, r"process 2 of 2 of the training died \(SIGKILL\); if memory ran out"),
        ("diverge", PerceptionError, "^training diverged\\n"),
        ("fail", RuntimeError, "^ZeroDivisionError: of all things\\n"),
    ],
)
def test_the_failure_of_one_process_ends_all_with_its_reason(what, error, message):
    reports = []
    with pytest.raises(error, match=message) as caught:
        run_on_ranks(act, what, 2, "cpu", lambda *message: reports.append(message))
    assert {rank for rank, *_ in reports} == {0, 1}
    assert not any(is_alive(pid) for _, pid, _ in reports)
    assert all(blocked for *_, blocked in reports)  # Ctrl-C is for the process of the command
    if what != "die":
        assert "in act" in "".join(caught.value.__notes__)


def test_an_interrupt_ends_all_processes():
    pids = []

    def interrupt(rank, pid, blocked):
        pids.append(pid)
        if len(pids) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_on_ranks(act, "wait", 2, "cpu", interrupt)
    assert len(pids) == 2 and not any(is_alive(pid) for pid in pids)


def draw(work: int, ranks, report) -> None:
    report(ranks.rank, work, torch.rand(2).tolist(), torch.get_num_threads())


def test_processes_continue_the_random_numbers_of_this_one():
    torch.manual_seed(4)
    expected, following = torch.rand(2).tolist(), torch.rand(2)
    torch.manual_seed(4)
    reports = []
    run_on_ranks(draw, 5, 2, "cpu", lambda *message: reports.append(message))
    threads = max(1, (os.cpu_count() or 1) // 2)
    assert sorted(reports) == [(0, 5, expected, threads), (1, 5, expected, threads)]
    np.testing.assert_array_equal(torch.rand(2), following)


def test_there_is_a_gpu_for_each_process(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    check_processes(64, "cpu")
    check_processes(2, "cuda")
    with pytest.raises(UsageError, match="--processes 3: one GPU for each, here are 2"):
        check_processes(3, "cuda")
    with pytest.raises(UsageError, match="--processes 0: at least one is needed"):
        check_processes(0, "cpu")
