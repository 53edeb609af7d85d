"""Processes of this machine that train one network together (``perception.distributed``).

The process of the command starts them for the optimisation alone, passes on their progress, and watches them:
it renders, evaluates and writes results itself, and is in no collective operation that could wait forever.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from app.errors import UsageError
from app.workers import end_with_parent, how_ended, start_without_interrupts
from perception.distributed import Ranks, process_group, random_state, set_random_state
from perception.errors import PerceptionError

Work = TypeVar("Work")
Report = Callable[..., None]

_GRACE = 2.0  # [s] in which the others notice the failure of one, and before they are killed


def check_processes(processes: int, device: str) -> None:
    """Check that the machine has a GPU for each process.

    Raises:
        UsageError: There are fewer, or less than one process is asked for.
    """
    if processes < 1:
        raise UsageError(f"--processes {processes}: at least one is needed")
    if device == "cuda" and processes > torch.cuda.device_count():
        found = torch.cuda.device_count()
        raise UsageError(f"--processes {processes}: one GPU for each, here are {found}")


def run_on_ranks(
    function: Callable[[Work, Ranks, Report], None],
    work: Work,
    processes: int,
    device: str,
    report: Report | None = None,
) -> None:
    """Call a function in several processes that form a process group, and wait until all have returned.

    Args:
        function: Importable function; is called with the work, the ranks as seen from its process, and a
            function whose arguments reach ``report``.
        work: Picklable description of what to do.
        processes: Number of processes.
        device: "cpu", whose cores they share, or "cuda", with one GPU for each.
        report: Called in this process.

    Raises:
        PerceptionError: A process died.
        Exception: The first exception of a process; the others are ended.
    """
    # Dropout and the like continue the random numbers of this process, as they would in it.
    start = _Start(function, work, processes, device, random_state(device))
    with tempfile.TemporaryDirectory(prefix="nodeslam-") as folder, _started(start, Path(folder)) as ranks:
        state = _watch(ranks, report or (lambda *_: None))
    set_random_state(device, state)


@dataclass(frozen=True)
class _Start:
    """What every process is started with."""

    function: Callable[[Any, Ranks, Report], None]
    work: Any
    processes: int
    device: str
    random_state: np.ndarray


@dataclass(frozen=True)
class _Returned:
    """The function has returned, with this state of the random numbers."""

    random_state: np.ndarray


@dataclass(frozen=True)
class _Raised:
    """The function has raised an exception at this time, in seconds."""

    time: float
    error: Exception
    trace: str


@dataclass(frozen=True)
class _Rank:
    """A process, seen from its parent."""

    number: int
    process: SpawnProcess
    connection: Connection


@contextmanager
def _started(start: _Start, folder: Path) -> Iterator[list[_Rank]]:
    """Start the processes; end those that still run at the end of the context."""
    context = multiprocessing.get_context("spawn")  # CUDA and threads do not survive a fork
    ranks: list[_Rank] = []
    try:
        for number in range(start.processes):
            near, far = context.Pipe()
            arguments = (far, start, number, folder / "store")
            process = context.Process(target=_serve, args=arguments, daemon=True)
            start_without_interrupts(process)
            far.close()
            ranks.append(_Rank(number, process, near))
        yield ranks
    finally:
        for rank in ranks:
            rank.process.terminate()
        deadline = time.monotonic() + _GRACE
        for rank in ranks:
            rank.process.join(max(deadline - time.monotonic(), 0))
            if rank.process.is_alive():
                rank.process.kill()
                rank.process.join()
            rank.connection.close()


def _watch(ranks: list[_Rank], report: Report) -> np.ndarray:
    """Pass on progress until all processes have returned; return the first one's random numbers."""
    returned: dict[int, np.ndarray] = {}
    while len(returned) < len(ranks):
        waiting = {rank.connection: rank for rank in ranks if rank.number not in returned}
        for connection in wait(list(waiting)):
            rank = waiting[connection]  # pyright: ignore[reportArgumentType]
            message = _receive(rank)
            if isinstance(message, _Returned):
                returned[rank.number] = message.random_state
            elif message is None or isinstance(message, _Raised):
                raise _failure(ranks, rank, message)
            else:
                report(*message)
    return returned[0]


def _receive(rank: _Rank) -> Any:
    """Return the next message of a process; None if it has ended."""
    try:
        return rank.connection.recv()
    except (EOFError, OSError):
        return None


def _failure(ranks: list[_Rank], first: _Rank, message: _Raised | None) -> Exception:
    """Return why the processes failed: one that died, else the earliest exception.

    The death of one soon breaks the connections of the others, whose exceptions may arrive first.
    """
    messages: dict[int, _Raised | _Returned | None] = {first.number: message}
    deadline = time.monotonic() + _GRACE
    for rank in ranks:
        while rank.number not in messages and rank.connection.poll(max(deadline - time.monotonic(), 0)):
            found = _receive(rank)
            if found is None or isinstance(found, _Raised | _Returned):
                messages[rank.number] = found
    for rank in ranks:
        if messages.get(rank.number, rank) is None:
            rank.process.join(_GRACE)
            end = how_ended(rank.process)
            hint = "; if memory ran out, use fewer --processes" if end == "SIGKILL" else ""
            return PerceptionError(
                f"process {rank.number + 1} of {len(ranks)} of the training died ({end}){hint}; the same "
                "command continues from the last checkpoint"
            )
    earliest = min((m for m in messages.values() if isinstance(m, _Raised)), key=lambda m: m.time)
    earliest.error.add_note(earliest.trace)
    return earliest.error


def _serve(connection: Connection, start: _Start, number: int, store: Path) -> None:
    """Join the group, call the function, and send how it ended."""
    end_with_parent()
    ranks = Ranks(number, start.processes)
    if start.device == "cpu":
        torch.set_num_threads(max(1, (os.cpu_count() or 1) // start.processes))
        # They are on one machine; the addresses of its name may be unreachable.
        os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo" if sys.platform == "linux" else "lo0")
    try:
        with process_group(ranks, start.device, store):
            set_random_state(start.device, start.random_state)
            start.function(start.work, ranks, lambda *message: connection.send(message))
            state = random_state(start.device)
        connection.send(_Returned(state))
    except Exception as error:
        connection.send(_raised(error))
        os._exit(1)  # threads of the group may wait for the others


def _raised(error: Exception) -> _Raised:
    """Return the message about an exception; only errors of ours can surely be pickled."""
    trace = traceback.format_exc()
    kept = error if type(error) is PerceptionError else RuntimeError(f"{type(error).__name__}: {error}")
    return _Raised(time.monotonic(), kept, trace)
