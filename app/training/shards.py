"""Shards of generated data: written by the process of the command, computed here, in workers or on a cluster.

Every shard has its own random numbers, so that its content depends on neither the number nor the machines of
the workers. Finished shards stay in the folder, where an interrupted command finds them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

from app.jobs import Failure, Jobs, Workers, run_jobs
from perception.errors import PerceptionError
from perception.io.files import write_atomically

Progress = Callable[[str, float], None]  # description of the current step, share of the job done
Contents = tuple[bytes, ...]  # of a shard's files, in the order of ``Shard.files``


@runtime_checkable
class Shard(Protocol):
    """Description of a shard, from which a worker computes its content.

    Attributes:
        number: Number of the shard in its data set.
        files: Files of the shard on the machine of the command.
    """

    @property
    def number(self) -> int: ...
    @property
    def files(self) -> tuple[Path, ...]: ...


AnyShard = TypeVar("AnyShard", bound=Shard)


def write_shards(
    shards: Sequence[AnyShard],
    contents: Callable[[AnyShard], Contents],
    workers: Workers,
    activity: str,
    progress: Progress | None = None,
) -> None:
    """Compute the shards whose files are not all there, and write each as soon as it is finished.

    Args:
        shards: All shards of the data set.
        contents: Importable function that returns the content of each file of a shard.
        workers: Where shards are computed.
        activity: What is done, such as "rendering train scenes", for progress and errors.
        progress: Called with the activity and the share of finished shards.

    Raises:
        PerceptionError: A shard failed, or its worker processes died.
    """
    missing = [shard for shard in shards if not all(file.is_file() for file in shard.files)]
    done = len(shards) - len(missing)
    jobs = Jobs(missing, partial(_compute, contents), _Computed)
    with closing(run_jobs(jobs, workers)) as results:  # an error ends the other workers
        for result in results:
            if isinstance(result.contents, Failure):
                raise PerceptionError(
                    f"{activity}: shard {result.shard.number} {result.contents.reason}; the same command "
                    "repeats it and keeps the finished ones"
                )
            for file, content in zip(result.shard.files, result.contents, strict=True):
                write_atomically(file, content)
            done += 1
            if progress:
                progress(activity, done / len(shards))


@dataclass(frozen=True)
class _Computed(Generic[AnyShard]):
    """A shard with the contents of its files, or with the reason why there are none."""

    shard: AnyShard
    contents: Contents | Failure


def _compute(contents: Callable[[AnyShard], Contents], shard: AnyShard) -> _Computed[AnyShard]:
    return _Computed(shard, contents(shard))
