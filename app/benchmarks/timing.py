"""Measurement of times on a loaded machine: job and reference alternate; medians and processor times.

Wall times grow with the load of other processes. Two figures are robust to it: the ratio of two jobs timed
alternately, and the processor time of a job.
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
    """A job and its reference: another implementation, or the same job with another input.

    Attributes:
        name: Description of the job.
        reference: Description of the reference.
        job: Job to time; called many times.
        reference_job: Reference to time.
        scale: Factor of the job's times, one over the number of units of work per call.
        reference_scale: Factor of the reference's times; above 1 where it performs only a part of the work.
        expensive: Whether the job is repeated only a few times.
        processor_time: Processor time so far of all processes that work on the job, in seconds.
    """

    name: str
    reference: str
    job: Job
    reference_job: Job
    scale: float = 1.0
    reference_scale: float = 1.0
    expensive: bool = False
    processor_time: Callable[[], float] = time.process_time


@dataclass(frozen=True)
class Row:
    """One line of the speed table.

    Attributes:
        name: Description of the job.
        value: Median wall time, in seconds.
        unit: Unit of the times, "s".
        reference: Description of the reference.
        ratio: Speed relative to the reference: ``reference_value`` over ``value``.
        reference_value: Median wall time of the reference, in seconds.
        best: Shortest wall time, in seconds; the closest to that of an idle machine.
        core_seconds: Median processor time of all threads, in seconds.
        repeats: Number of repetitions.
        reference_core_seconds: Median processor time of the reference, in seconds.
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
    reference_core_seconds: float

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class TimingConfig:
    """Number of repetitions.

    Attributes:
        min_repeats: Smallest number of repetitions; half as many, rounded up, of an expensive job.
        max_repeats: Largest number of repetitions.
        seconds: Time after which a row ends, in seconds, once it has ``min_repeats``.
    """

    min_repeats: int = 5
    max_repeats: int = 100
    seconds: float = 2.0


def measure(benchmark: Benchmark, config: TimingConfig = TimingConfig()) -> Row:
    """Time a job and its reference alternately, after one untimed call of each."""
    fewest = (config.min_repeats + 1) // 2 if benchmark.expensive else config.min_repeats
    benchmark.job()
    benchmark.reference_job()
    values, references, cores, reference_cores = [], [], [], []
    begin = time.perf_counter()
    while len(values) < fewest or (
        len(values) < config.max_repeats and time.perf_counter() - begin < config.seconds
    ):
        wall, core = clocked(benchmark.job, benchmark.processor_time)
        values.append(benchmark.scale * wall)
        cores.append(benchmark.scale * core)
        wall, core = clocked(benchmark.reference_job, benchmark.processor_time)
        references.append(benchmark.reference_scale * wall)
        reference_cores.append(benchmark.reference_scale * core)
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
        reference_core_seconds=median(reference_cores),
    )


def clocked(job: Job, processor_time: Callable[[], float] = time.process_time) -> tuple[float, float]:
    """Return wall time and processor time of one call, in seconds."""
    core, wall = processor_time(), time.perf_counter()
    job()
    return time.perf_counter() - wall, processor_time() - core
