"""Worker processes: order of results, deaths of workers, and the end of the parent."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from app.workers import THREAD_POOLS, Lost, end_with_parent, map_in_processes

# Workers import their function by name, so it is in a module on the path.
MODULE = '''
import os, signal, time
from pathlib import Path
from app.workers import THREAD_POOLS

def square(number):
    return number**2, os.getpid(), [os.environ.get(name) for name in THREAD_POOLS]

def sleep(seconds):
    time.sleep(seconds)
    return seconds

def fragile(item):
    """Die as often as the item says; each death leaves a file."""
    folder, name, deaths = item
    time.sleep(0.1)
    marks = len(list(Path(folder).glob(f"{name}-*")))
    if marks < deaths:
        Path(folder, f"{name}-{os.getpid()}").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return name

def leave(code):
    os._exit(code)

def broken(number):
    if number == 2:
        raise ZeroDivisionError("of all things")
    time.sleep(60)

def unpicklable(number):
    return lambda: number

def prepare():
    os.environ["OMP_NUM_THREADS"] = "prepared"
'''


@pytest.fixture
def functions(tmp_path, monkeypatch):
    folder = tmp_path / "modules"
    folder.mkdir()
    (folder / "functions_of_workers.py").write_text(MODULE)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "functions_of_workers", raising=False)
    for name in THREAD_POOLS:
        monkeypatch.setenv(name, "7")
    import functions_of_workers  # pyright: ignore[reportMissingImports]

    return functions_of_workers


def test_workers_are_single_threaded_prepared_and_reused(functions):
    results = dict(map_in_processes(functions.square, list(range(6)), 2, functions.prepare))
    assert [results[n][0] for n in range(6)] == [0, 1, 4, 9, 16, 25]
    processes = {process for _, process, _ in results.values()}
    assert len(processes) == 2 and os.getpid() not in processes
    assert all(pools == ["prepared", "1", "1"] for *_, pools in results.values())
    assert not any(map(is_running, processes))


def test_results_come_in_order_of_completion(functions):
    assert [item for item, _ in map_in_processes(functions.sleep, [2.0, 0.0], 2)] == [0.0, 2.0]


def test_an_item_of_a_killed_worker_is_repeated_once_and_the_others_are_not_disturbed(functions, tmp_path):
    items = [(str(tmp_path), f"item{deaths}{n}", deaths) for n in range(2) for deaths in range(3)]
    results = dict(map_in_processes(functions.fragile, items, 2))
    assert len(results) == len(items)
    for item in items:
        folder, name, deaths = item
        if deaths < 2:
            assert results[item] == name
            continue
        lost = results[item]
        assert isinstance(lost, Lost) and lost.seconds > 0.2
        assert lost.reason == (
            "its worker process died 2 times (SIGKILL, then SIGKILL); if memory ran out, use fewer --workers"
        )
        assert len(list(Path(folder).glob(f"{name}-*"))) == 2


def test_an_exit_of_a_worker_is_reported_with_its_code(functions):
    ((_, lost),) = map_in_processes(functions.leave, [3], 1)
    assert lost.reason == "its worker process died 2 times (exit code 3, then exit code 3)"


def test_an_exception_of_the_function_ends_the_iteration_and_the_workers(functions):
    begin = time.perf_counter()
    with pytest.raises(ZeroDivisionError, match="of all things"):
        list(map_in_processes(functions.broken, [1, 2, 3], 2))
    assert time.perf_counter() - begin < 50


def test_a_result_that_cannot_be_sent_is_an_error(functions):
    with pytest.raises((AttributeError, TypeError), match="pickle"):
        list(map_in_processes(functions.unpicklable, [1], 1))


PARENT = """
import sys
sys.path.insert(0, sys.argv[1])
import functions_of_workers as functions
from app.workers import map_in_processes
if __name__ == "__main__":
    results = map_in_processes(functions.square, list(range(3)), 2)
    for count, (_, (_, process, _)) in enumerate(results, start=1):
        print(process, flush=True)
        if count == 3:
            sys.stdin.readline()
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_when_their_parent_is_killed(functions, tmp_path, number):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    command = [sys.executable, str(script), str(Path(functions.__file__).parent)]
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as parent:
        assert parent.stdout is not None
        workers = {int(parent.stdout.readline()) for _ in range(3)}
        assert all(map(is_running, workers))
        parent.send_signal(number)
        parent.wait(10)
    deadline = time.monotonic() + 10
    while any(map(is_running, workers)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(map(is_running, workers))


def test_a_process_without_a_parent_of_its_kind_goes_on():
    end_with_parent()


def is_running(process: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_an_item_that_takes_too_long_is_lost_and_the_others_go_on(functions):
    found = dict(map_in_processes(functions.sleep, [60, 0.0, 0.1], workers=2, limit=5))
    assert found[60] == Lost("no result within 5 s", 5) and found[0.0] == 0.0 and found[0.1] == 0.1
