"""Ledgers of results, and jobs in this process and in others."""

import json
import os
import subprocess
import sys
from functools import partial

import pytest
import torch

from app.errors import UsageError
from app.evaluation.jobs import SETTINGS, THREAD_POOLS, Ledger, resident_memory, spread
from app.options import EvaluateOptions


def options(out, **changes):
    return EvaluateOptions(what="tasks", out=out, **changes)


def opened(out, settings=None, **changes):
    return Ledger.open(
        options(out, **changes), "evaluate-tasks", "lines.jsonl", "seed", settings or {"task": "pack"}
    )


def test_lines_are_read_back_by_key(tmp_path):
    ledger, finished = opened(tmp_path)
    assert finished == {}
    ledger.append({"seed": 4, "value": 0.5})
    ledger.append({"seed": 2, "value": 1.5})
    again, finished = opened(tmp_path, resume=True)
    assert finished == {4: {"seed": 4, "value": 0.5}, 2: {"seed": 2, "value": 1.5}}
    assert again.path == ledger.path and again.folder.path == tmp_path


def test_damaged_lines_are_dropped_from_the_file(tmp_path):
    ledger, _ = opened(tmp_path)
    ledger.append({"seed": 1})
    with ledger.path.open("a") as file:
        file.write('{"value": 1}\n[1]\n{"seed": 2, "va')
    assert list(ledger.read()) == [1]
    assert ledger.path.read_text() == '{"seed": 1}\n'


def test_a_new_evaluation_removes_old_lines(tmp_path):
    ledger, _ = opened(tmp_path)
    ledger.append({"seed": 1})
    assert opened(tmp_path)[0].read() == {}
    assert json.loads((tmp_path / SETTINGS).read_text()) == {"task": "pack"}


def test_settings_must_agree_to_resume(tmp_path):
    opened(tmp_path, {"task": "pack", "box": "a"})
    with pytest.raises(UsageError, match="was made with another box, task"):
        opened(tmp_path, {"task": "sort", "box": "b"}, resume=True)
    opened(tmp_path, {"task": "pack", "box": "a", "robot": "panda"}, resume=True)  # the default of --robot
    with pytest.raises(UsageError, match="--resume needs --out"):
        opened(None, resume=True)


def square(number):
    return {"seed": number, "square": number**2, "process": os.getpid()}


def test_one_worker_runs_in_this_process_in_order(tmp_path):
    lines = list(spread(square, [3, 1, 2], options(tmp_path)))
    assert [line["square"] for line in lines] == [9, 1, 4]
    assert {line["process"] for line in lines} == {os.getpid()}


def test_jobs_start_only_when_their_result_is_wanted(tmp_path):
    started = []
    results = spread(lambda item: started.append(item) or {"seed": item}, [1, 2], options(tmp_path))
    next(results)
    assert started == [1]


def test_one_worker_has_one_thread_as_the_processes_have(tmp_path):
    """Sums of several threads round differently: results would depend on the number of workers."""
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        results = spread(lambda item: {"threads": torch.get_num_threads()}, [1, 2], options(tmp_path))
        assert next(results) == {"threads": 1}
        assert torch.get_num_threads() == 3  # between jobs and after an interruption
        assert list(results) == [{"threads": 1}]
        results = spread(lambda item: 1 / item, [0], options(tmp_path))
        with pytest.raises(ZeroDivisionError):
            next(results)
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)


def test_several_workers_are_processes_with_one_thread_each(tmp_path, monkeypatch):
    for name in THREAD_POOLS:
        monkeypatch.setenv(name, "7")
    environments = list(
        spread(partial(subprocess.check_output, text=True), PROBES, options(tmp_path, workers=2))
    )
    first, second = (text.split() for text in environments)
    assert first[1:] == second[1:] == ["1"] * len(THREAD_POOLS)
    assert str(os.getpid()) not in (first[0], second[0])


# The workers import their function by name, so it is one of the standard library: it prints the environment.
PROBE = f"import os; print(os.getppid(), *(os.environ[name] for name in {THREAD_POOLS}))"
PROBES = [[sys.executable, "-c", PROBE]] * 2


def test_resident_memory_is_that_of_this_process():
    memory = resident_memory()
    assert memory is None or 10e6 < memory < 64e9
