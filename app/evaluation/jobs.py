"""Resumable evaluations: independent jobs, each of which appends one line of results when it finishes.

An interrupted evaluation continues with ``--resume``. Jobs run in single-threaded processes, on this machine
or on a Ray cluster.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from app.errors import MissingExtraError, UsageError
from app.options import EvaluateOptions
from app.runs.run_folder import RunFolder
from perception.errors import install_hint
from perception.io.files import read_json, write_json

THREAD_POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SETTINGS = "evaluation.json"

Line = dict[str, Any]
Item = TypeVar("Item")


@dataclass(frozen=True)
class Ledger:
    """Results of finished jobs: a file in the run folder with one JSON object per line.

    Attributes:
        folder: Run folder.
        path: File.
        key: Entry of a line that identifies its job.
    """

    folder: RunFolder
    path: Path
    key: str

    @staticmethod
    def open(
        options: EvaluateOptions, command: str, file: str, key: str, settings: Mapping[str, Any]
    ) -> tuple[Ledger, dict[Hashable, Line]]:
        """Open the ledger; return it with its finished lines by key. Without ``--resume`` it is empty.

        Raises:
            UsageError: There is nothing to resume, or it has other settings.
        """
        if not options.resume:
            folder = RunFolder.create(options, command)
            (folder.path / file).unlink(missing_ok=True)
            write_json(folder.path / SETTINGS, settings)
            return Ledger(folder, folder.path / file, key), {}
        if options.out is None:
            raise UsageError("--resume needs --out with the folder to continue in")
        kept = read_json(options.out / SETTINGS, "give the --out of the evaluation to be resumed")
        old = kept if isinstance(kept, dict) else {}
        # Options that a stored evaluation lacks had their defaults.
        before = {name: str(getattr(EvaluateOptions, name, None)) for name in settings} | old
        different = sorted(name for name in settings if before[name] != settings[name])
        if different:
            raise UsageError(f"--resume: {options.out} was made with another {', '.join(different)}")
        ledger = Ledger(RunFolder(options.out), options.out / file, key)
        return ledger, ledger.read()

    def append(self, line: Line) -> None:
        """Append a line and flush it to disk."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def read(self) -> dict[Hashable, Line]:
        """Read the finished lines by key; a truncated line is dropped, so that its job is repeated."""
        lines: dict[Hashable, Line] = {}
        if not self.path.exists():
            return lines
        whole = []
        for text in self.path.read_text(encoding="utf-8").splitlines():
            try:
                line = json.loads(text)
                lines[line[self.key]] = line
                whole.append(text)
            except (ValueError, KeyError, TypeError):
                continue
        self.path.write_text("".join(text + "\n" for text in whole), encoding="utf-8")
        return lines


def spread(work: Callable[[Item], Line], items: Sequence[Item], options: EvaluateOptions) -> Iterator[Line]:
    """Run jobs and yield their results in order of completion.

    Every job runs single-threaded: sums of several threads round differently, and a fit amplifies that. The
    results depend on neither the number of workers nor their timing.
    """
    if options.ray is not None:
        yield from _on_ray(work, items, options.ray)
    elif options.workers == 1:
        yield from _in_this_process(work, items)
    else:
        yield from _in_processes(work, items, options.workers)


def resident_memory() -> int | None:
    """Return the resident memory of this process in bytes; None on systems other than Linux."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def _in_this_process(work: Callable[[Item], Line], items: Sequence[Item]) -> Iterator[Line]:
    from perception.inference.reconstruct import single_threaded_torch

    for item in items:
        with single_threaded_torch():
            line = work(item)
        yield line


def _in_processes(work: Callable[[Item], Line], items: Sequence[Item], workers: int) -> Iterator[Line]:
    os.environ.update(
        dict.fromkeys(THREAD_POOLS, "1")
    )  # inherited by the workers: their thread pools would compete
    context = multiprocessing.get_context("spawn")  # a GL context does not survive a fork
    with ProcessPoolExecutor(workers, mp_context=context, initializer=_single_threaded) as pool:
        jobs = [pool.submit(work, item) for item in items]
        try:
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _single_threaded() -> None:
    import torch

    torch.set_num_threads(1)


def _on_ray(work: Callable[[Item], Line], items: Sequence[Item], address: str) -> Iterator[Line]:
    try:
        import ray
    except ImportError:
        raise MissingExtraError(f"--ray needs Ray: {install_hint('cluster')}") from None
    ray.init(address=address, log_to_driver=False)
    waiting = [ray.remote(num_cpus=1)(work).remote(item) for item in items]
    try:
        while waiting:
            finished, waiting = ray.wait(waiting)
            yield from ray.get(finished)
    finally:
        ray.shutdown()
