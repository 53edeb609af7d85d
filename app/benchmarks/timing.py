"""Taking time so that a busy machine hurts little: value and reference in turns, medians, core seconds.

On a machine that others use too, wall times grow with what the others do. Two things hold all the same: the
ratio of two jobs that were timed alternately, and the core time that a job consumed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

Job = Callable[[], Any]


@dataclass(frozen=True)
class Benchmark:
    """Two ways to the same thing, or one thing with more and with less.

    Attributes:
        name: what is timed.
        reference: what it is compared with, in words.
        job: what is timed; called many times.
        reference_job: what it is compared with.
        scale: of the job's times: one over the number of things that one call does.
        reference_scale: the same for the reference, also where it does only a part of the whole.
        expensive: called a few times only.
    """

    name: str
    reference: str
    job: Job
    reference_job: Job
    scale: float = 1.0
    reference_scale: float = 1.0
    expensive: bool = False


@dataclass(frozen=True)
class Row:
    """One line of the speed table.

    Attributes:
        name: what was timed.
        value: median wall time [s].
        unit: "s".
        reference: what it is compared with, in words.
        ratio: median wall time of the reference over ``value``: how many times as fast as the reference.
        reference_value: median wall time of the reference [s].
        best: shortest wall time [s], nearest to an idle machine's.
        core_seconds: median time on cores, all threads together [s]; other processes do not change it.
        repeats: how often it was timed.
    """

    name: str
    value: float
    unit: str
    reference: str
    ratio: float
    reference_value: float
    best: float
    core_seconds: float
    repeats: int

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class TimingConfig:
    """How long to repeat.

    Attributes:
        min_repeats: of a cheap job; half as many, rounded up, of an expensive one.
        max_repeats: even if there is time left.
        seconds: spent on one row, unless that is too short for ``min_repeats``.
    """

    min_repeats: int = 5
    max_repeats: int = 100
    seconds: float = 2.0


def measure(benchmark: Benchmark, config: TimingConfig | None = None) -> Row:
    """Times the job and its reference in turns, after one untimed call of each."""
    config = config or TimingConfig()
    fewest = (config.min_repeats + 1) // 2 if benchmark.expensive else config.min_repeats
    benchmark.job()
    benchmark.reference_job()
    values, references, cores = [], [], []
    begin = time.perf_counter()
    while len(values) < fewest or (
        len(values) < config.max_repeats and time.perf_counter() - begin < config.seconds
    ):
        wall, core = clocked(benchmark.job)
        values.append(benchmark.scale * wall)
        cores.append(benchmark.scale * core)
        references.append(benchmark.reference_scale * clocked(benchmark.reference_job)[0])
    return Row(
        name=benchmark.name,
        value=median(values),
        unit="s",
        reference=benchmark.reference,
        ratio=median(references) / median(values),
        reference_value=median(references),
        best=min(values),
        core_seconds=median(cores),
        repeats=len(values),
    )


def clocked(job: Job) -> tuple[float, float]:
    """Wall time and core time of one call in [s]."""
    core, wall = time.process_time(), time.perf_counter()
    job()
    return time.perf_counter() - wall, time.process_time() - core
