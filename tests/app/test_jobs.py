"""Jobs in this process and in others; failures become results."""

import os
import sys
import types

import pytest
import torch

from app.errors import MissingExtraError, UsageError
from app.jobs import Jobs, attempt_job, reason_of, resident_memory, run_jobs
from app.options import EvaluateOptions


def options(out=None, **changes):
    return EvaluateOptions(what="tasks", out=out, **changes)


def square(number):
    return {"seed": number, "square": number**2, "process": os.getpid()}


def failed(item, failure):
    return {"seed": item, "reason": failure.reason, "seconds": failure.seconds}


def test_one_worker_runs_in_this_process_in_order():
    lines = list(run_jobs(Jobs([3, 1, 2], square, failed), options()))
    assert [line["square"] for line in lines] == [9, 1, 4]
    assert {line["process"] for line in lines} == {os.getpid()}


def test_one_worker_has_one_thread_as_the_processes_have():
    """Sums of several threads round differently: results would depend on the number of workers."""
    threads = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        jobs = Jobs([1, 2], lambda item: {"threads": torch.get_num_threads()}, failed)
        results = run_jobs(jobs, options())
        assert next(results) == {"threads": 1}
        assert torch.get_num_threads() == 3  # between jobs and after a failure
        assert list(results) == [{"threads": 1}]
        (line,) = run_jobs(Jobs([0], lambda item: 1 / item, failed), options())
        assert line["reason"] == "crashed: ZeroDivisionError: division by zero"
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)


def test_jobs_start_only_when_their_result_is_wanted():
    started = []
    results = run_jobs(Jobs([1, 2], lambda item: started.append(item) or {"seed": item}, failed), options())
    next(results)
    assert started == [1]


def test_a_failed_job_is_a_line_and_the_others_go_on():
    def work(item):
        if item == 1:
            raise ZeroDivisionError("of all\n things")
        if item == 2:
            raise UsageError("--objects 10: no room")
        return {"seed": item}

    first, second, third = run_jobs(Jobs([1, 2, 3], work, failed), options())
    assert first["reason"] == "crashed: ZeroDivisionError: of all things" and 0 <= first["seconds"] < 5
    assert second["reason"] == "failed: --objects 10: no room" and third == {"seed": 3}


@pytest.mark.parametrize("error", [MissingExtraError("no Ray"), ModuleNotFoundError("no mujoco")])
def test_a_missing_library_ends_the_evaluation(error):
    def work(item):
        raise error

    with pytest.raises(type(error)):
        list(run_jobs(Jobs([1, 2], work, failed), options()))


def test_an_interrupt_is_not_a_failure():
    def work(item):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        attempt_job(work, failed, 1)


def test_reasons_are_short():
    assert len(reason_of(ValueError("x" * 10_000))) == 500


MODULE = """
import os, signal

def work(item):
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    if item == 3:
        raise ValueError("bad layout")
    return {"seed": item}

def failed(item, failure):
    return {"seed": item, "reason": failure.reason}
"""


def test_killed_workers_and_exceptions_are_lines(tmp_path, monkeypatch):
    (tmp_path / "jobs_of_workers.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "jobs_of_workers", raising=False)
    from jobs_of_workers import failed, work  # pyright: ignore[reportMissingImports]

    lines = {line["seed"]: line for line in run_jobs(Jobs([1, 2, 3, 4], work, failed), options(workers=2))}
    assert lines[1] == {"seed": 1} and lines[4] == {"seed": 4}
    assert lines[2]["reason"].startswith("crashed: its worker process died 2 times (SIGKILL, then SIGKILL)")
    assert lines[3]["reason"] == "crashed: ValueError: bad layout"


@pytest.fixture
def ray(monkeypatch):
    """A stand-in for Ray that computes when a result is asked for."""

    class RayError(Exception):
        pass

    class RayTaskError(RayError):
        pass

    module = types.ModuleType("ray")
    module.calls = []
    module.init = lambda **arguments: module.calls.append(arguments)
    module.shutdown = lambda: module.calls.append("shutdown")
    module.exceptions = types.SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def remote(**limits):
        module.calls.append(limits)
        return lambda function: types.SimpleNamespace(remote=lambda *given: (function, given))

    module.remote = remote
    module.put = lambda value: module.calls.append("put") or value
    module.wait = lambda waiting: (waiting[-1:], waiting[:-1])
    module.get = lambda reference: reference[0](*reference[1])
    monkeypatch.setitem(sys.modules, "ray", module)
    return module


def test_a_dead_machine_of_a_ray_cluster_is_a_failure(ray):
    def work(item):
        return {"seed": item}

    compute = ray.get

    def get(reference):
        if reference[1][-1] == 2:
            raise ray.exceptions.RayError("node died")
        return compute(reference)

    ray.get = get
    lines = list(run_jobs(Jobs((1, 2, 3), work, failed), options(ray="here")))
    assert [line["seed"] for line in lines] == [3, 2, 1]
    assert lines[1]["reason"] == "crashed: RayError: node died"
    assert ray.calls == [
        {"address": "here", "log_to_driver": False}, {"num_cpus": 1, "max_retries": 1}, "put", "shutdown",
    ]  # fmt: skip


def test_resident_memory_is_that_of_this_process():
    memory = resident_memory()
    assert memory is None or 10e6 < memory < 64e9
