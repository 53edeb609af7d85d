"""Worker processes that survive each other's deaths and end with the process that started them.

``concurrent.futures`` and ``loky`` break the whole pool when one worker is killed, and do not tell which item
it was working on. Here each worker has a pipe of its own and one item at a time, so that the item of a killed
worker is known: it is repeated once in a new process, and the other workers are not disturbed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

from sim_assets.processes import kill_with

Item = TypeVar("Item")
Result = TypeVar("Result")

ATTEMPTS = 2  # processes that may die on an item before it is given up
THREAD_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_GRACE = 5.0  # [s] for a process to end before it is killed


@dataclass(frozen=True)
class Lost:
    """Failure of an item whose worker processes died.

    Attributes:
        reason: How the last of them ended.
        seconds: Wall time since the item was first handed to a worker.
    """

    reason: str
    seconds: float


def map_in_processes(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int,
    prepare: Callable[[], object] | None = None,
    limit: float = 0.0,
) -> Iterator[tuple[Item, Result | Lost]]:
    """Apply a function to items in worker processes; yield (item, result) in order of completion.

    Args:
        function: Importable function; an exception that it raises ends the iteration and all workers.
        items: Arguments, each independent of the others.
        workers: Largest number of processes at a time.
        prepare: Importable function that each process calls at its start.
        limit: Time for one item in seconds, after which its process is ended and it is lost; 0 for none.
    """
    os.environ.update(
        dict.fromkeys(THREAD_POOLS, "1")
    )  # inherited by the workers: their thread pools would compete
    waiting = deque(_Task(item) for item in items)
    idle: list[_Worker[Item, Result]] = []
    busy: list[_Worker[Item, Result]] = []
    done: list[tuple[Item, Result | Lost | _Raised]] = []
    try:
        while waiting or busy or done:
            while waiting and len(busy) < workers:
                worker = idle.pop() if idle else _Worker.start(function, prepare)
                busy.append(worker)
                worker.assign(waiting.popleft())
            for item, result in done:
                if isinstance(result, _Raised):
                    raise result.error
                yield item, result
            done = []
            for worker in _ready(busy, limit):
                busy.remove(worker)
                try:
                    done.append((worker.task.item, worker.receive()))
                    idle.append(worker)
                except EOFError:  # the process died, or takes too long
                    overdue = worker.is_overdue(limit)
                    task = worker.task.after(worker.end(kill=overdue))
                    if overdue:
                        done.append((task.item, Lost(f"no result within {limit:g} s", limit)))
                    elif len(task.deaths) < ATTEMPTS:
                        waiting.appendleft(task)
                    else:
                        done.append((task.item, Lost(task.reason, time.perf_counter() - task.begin)))
    finally:
        for worker in idle:
            worker.connection.close()  # it returns
        for worker in busy:
            worker.process.terminate()
        for worker in (*idle, *busy):
            worker.end()


@dataclass(frozen=True)
class _Task(Generic[Item]):
    """An item, and how the processes ended that died on it.

    Attributes:
        item: The item.
        begin: Time at which it was first handed to a worker, in seconds.
        deaths: Signal or exit code of each process.
    """

    item: Item
    begin: float = 0.0
    deaths: tuple[str, ...] = ()

    def after(self, death: str) -> _Task[Item]:
        return replace(self, deaths=(*self.deaths, death))

    @property
    def reason(self) -> str:
        ends = ", then ".join(self.deaths)
        hint = "; if memory ran out, use fewer --workers" if "SIGKILL" in self.deaths else ""
        return f"its worker process died {len(self.deaths)} times ({ends}){hint}"


@dataclass(frozen=True)
class _Raised:
    """Exception of the function, on its path to the parent process."""

    error: BaseException


class _Worker(Generic[Item, Result]):
    """A worker process, seen from its parent."""

    def __init__(self, process: SpawnProcess, connection: Any) -> None:
        self.process, self.connection = process, connection
        self.task: _Task[Item]
        self.started = 0.0  # when this process got the item [s]

    @staticmethod
    def start(
        function: Callable[[Item], Result], prepare: Callable[[], object] | None
    ) -> _Worker[Item, Result]:
        """Start a process that applies the function to the items it receives."""
        context = multiprocessing.get_context("spawn")  # a GL context does not survive a fork
        near, far = context.Pipe()
        process = context.Process(target=_serve, args=(far, function, prepare), daemon=True)
        start_without_interrupts(process)
        far.close()  # so that the death of the worker is the end of the stream
        return _Worker(process, near)

    def assign(self, task: _Task[Item]) -> None:
        self.started = time.perf_counter()
        self.task = task if task.deaths else replace(task, begin=time.perf_counter())
        with contextlib.suppress(OSError):  # it died while it was idle: `receive` raises EOFError
            self.connection.send(task.item)

    def receive(self) -> Result | _Raised:
        """Return the result.

        Raises:
            EOFError: The process ended without one.
        """
        try:
            if not self.connection.poll():
                raise EOFError
            return self.connection.recv()
        except OSError:  # killed while it wrote
            raise EOFError from None

    def is_overdue(self, limit: float) -> bool:
        """Return whether the process has worked on its item for longer than the limit in seconds."""
        return limit > 0 and time.perf_counter() > self.started + limit

    def end(self, kill: bool = False) -> str:
        """Wait until the process has ended, killing it if it does not, and return how it ended."""
        if kill:
            self.process.kill()
        self.process.join(_GRACE)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.connection.close()
        return how_ended(self.process)


def start_without_interrupts(process: SpawnProcess) -> None:
    """Start a process that inherits a blocked SIGINT.

    Ctrl-C reaches the whole process group; the process of the command decides what becomes of the others.
    """
    resource_tracker.ensure_running()  # its start would unblock the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def how_ended(process: SpawnProcess) -> str:
    """Return the signal that ended a process, or its exit code."""
    code = process.exitcode or 0
    if code >= 0:
        return f"exit code {code}"
    with contextlib.suppress(ValueError):
        return signal.Signals(-code).name
    return f"signal {-code}"


def _ready(busy: Sequence[_Worker[Item, Result]], limit: float) -> list[_Worker[Item, Result]]:
    """Return the workers with a result, those whose process ended and those that take longer than the limit,
    as soon as there is one."""
    if not busy:
        return []
    handles = [handle for worker in busy for handle in (worker.connection, worker.process.sentinel)]
    first = min(worker.started for worker in busy) + limit
    ready = wait(handles, max(first - time.perf_counter(), 0) + 0.01 if limit > 0 else None)
    return [
        worker
        for worker in busy
        if worker.connection in ready or worker.process.sentinel in ready or worker.is_overdue(limit)
    ]


def _serve(connection: Any, function: Callable[[Item], Result], prepare: Callable[[], object] | None) -> None:
    """Work on items until the parent closes the connection or ends."""
    end_with_parent()
    if prepare is not None:
        prepare()
    while True:
        try:
            item = connection.recv()
        except (EOFError, OSError):
            return
        try:
            connection.send(function(item))
        except Exception as error:
            connection.send(_Raised(error))


def end_with_parent() -> None:
    """End this process when the one that started it is gone, whatever ended that.

    A thread waits for the end of the pipe that ``multiprocessing`` keeps open in the parent. On Linux the
    kernel sends SIGKILL as well, which no native code can delay.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
    if parent.pid is not None:
        kill_with(parent.pid)
