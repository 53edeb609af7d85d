"""Independent jobs of a command: in this process, in worker processes or on a Ray cluster.

A job that fails, whatever the reason, yields a result with that reason; the others go on. Results are
returned to the process of the command: machines of a cluster need not share a file system.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar, runtime_checkable

from app.errors import AppError, MissingExtraError
from app.memory import release_freed_memory
from app.options import Device
from app.workers import ATTEMPTS, Lost, map_in_processes
from perception.errors import install_hint

if TYPE_CHECKING:
    from perception.pipeline import Perception

Item = TypeVar("Item")
Result = TypeVar("Result")
_LONGEST_REASON = 500  # characters


@dataclass(frozen=True)
class Failure:
    """Why an item has no result.

    Attributes:
        reason: One line.
        seconds: Wall time spent on it.
    """

    reason: str
    seconds: float


@dataclass(frozen=True)
class Jobs(Generic[Item, Result]):
    """Independent jobs; both functions must be importable by other processes.

    Attributes:
        items: Items to work on.
        work: Returns the result of an item.
        failed: Returns the result of an item that failed.
    """

    items: Sequence[Item]
    work: Callable[[Item], Result]
    failed: Callable[[Item, Failure], Result]


@runtime_checkable
class WorkerSettings(Protocol):
    """Where jobs run, as in ``app.options.WorkerOptions``.

    Attributes:
        workers: Number of processes; one is this process.
        ray: Address of a Ray cluster to run on instead.
        stage_limit: Time for one job in a worker process, in seconds; 0 for none.
    """

    @property
    def workers(self) -> int: ...
    @property
    def ray(self) -> str | None: ...
    @property
    def stage_limit(self) -> float: ...


@dataclass(frozen=True)
class Workers:
    """Where the jobs of a command without a limit for each run; attributes as in ``WorkerSettings``."""

    workers: int = 1
    ray: str | None = None
    stage_limit: float = 0.0


def run_jobs(jobs: Jobs[Item, Result], options: WorkerSettings) -> Generator[Result, None, None]:
    """Run jobs and yield their results in order of completion.

    Every job runs single-threaded: sums of several threads round differently, and a fit amplifies that. The
    results depend on neither the number of workers nor their timing.

    Raises:
        MissingExtraError, ModuleNotFoundError: A library is not installed; no job can succeed.
    """
    attempt = partial(attempt_job, jobs.work, jobs.failed)
    if options.ray is not None:
        yield from _on_ray(jobs, options.ray)
    elif options.workers == 1:
        yield from _in_this_process(attempt, jobs.items)
    else:
        for item, result in map_in_processes(
            attempt, jobs.items, options.workers, single_threaded, options.stage_limit
        ):
            if isinstance(result, Lost):
                result = jobs.failed(item, Failure(f"crashed: {result.reason}", result.seconds))
            yield result


def attempt_job(
    work: Callable[[Item], Result], failed: Callable[[Item, Failure], Result], item: Item
) -> Result:
    """Return the result of an item; an exception becomes the reason of its failure."""
    begin = time.perf_counter()
    try:
        return work(item)
    except (MissingExtraError, ModuleNotFoundError):
        raise
    except Exception as error:
        return failed(item, Failure(reason_of(error), time.perf_counter() - begin))
    finally:
        release_freed_memory()


def single_threaded() -> None:
    """Let PyTorch use one thread in this process: workers would compete for the cores."""
    os.environ["OMP_NUM_THREADS"] = "1"  # read when PyTorch is loaded, which few jobs need
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def reason_of(error: Exception) -> str:
    """Return the reason of a failure in one line; errors of the application explain themselves."""
    text = " ".join(str(error).split())
    reason = f"failed: {text}" if isinstance(error, AppError) else f"crashed: {type(error).__name__}: {text}"
    return reason[:_LONGEST_REASON]


@cache
def networks_on(device: Device) -> Perception:
    """Load the shipped networks, once in each process."""
    from perception.pipeline import load_perception

    return load_perception(device)


def resident_memory() -> int | None:
    """Return the resident memory of this process in bytes; None on systems other than Linux."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def _in_this_process(attempt: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    from perception.threads import single_threaded

    for item in items:
        with single_threaded():
            result = attempt(item)
        yield result


def _attempt_on_ray(
    functions: tuple[Callable[[Item], Result], Callable[[Item, Failure], Result]], item: Item
) -> Result:
    from perception.threads import single_threaded

    with single_threaded():
        return attempt_job(*functions, item)


def _on_ray(jobs: Jobs[Item, Result], address: str) -> Iterator[Result]:
    try:
        import ray
    except ImportError:
        raise MissingExtraError(f"--ray needs Ray: {install_hint('cluster')}") from None
    ray.init(address=address, log_to_driver=False)
    begin = time.perf_counter()
    remote = ray.remote(num_cpus=1, max_retries=ATTEMPTS - 1)(_attempt_on_ray)
    functions = ray.put((jobs.work, jobs.failed))  # sent once to each machine, not with every item
    item_of = {remote.remote(functions, item): item for item in jobs.items}
    try:
        while item_of:
            (finished,), _ = ray.wait(list(item_of))
            item = item_of.pop(finished)
            try:
                result = ray.get(finished)
            except ray.exceptions.RayTaskError:  # raised by the job: a library is missing there
                raise
            except ray.exceptions.RayError as error:  # its process or machine died
                result = jobs.failed(item, Failure(reason_of(error), time.perf_counter() - begin))
            del finished  # the last reference to it: the cluster frees the result
            yield result
    finally:
        ray.shutdown()
