"""Alternating measurements and their summary."""

import time

import pytest

from app.benchmarks import timing
from app.benchmarks.timing import Benchmark, TimingConfig, clocked, measure

QUICK = TimingConfig(min_repeats=3, max_repeats=3, seconds=0.0)


def test_value_and_reference_are_timed_in_turns_and_scaled():
    calls = []
    benchmark = Benchmark(
        "sleep",
        "three times as long",
        lambda: (calls.append("job"), time.sleep(0.01)),
        lambda: (calls.append("reference"), time.sleep(0.03)),
        scale=0.5,
        reference_scale=0.5,
    )
    row = measure(benchmark, QUICK)
    assert calls == ["job", "reference"] * 4  # the first of each to warm up
    assert row.repeats == 3 and row.unit == "s"
    assert row.best <= row.value and row.value >= 0.005 and row.ratio > 1.2
    assert row.ratio == pytest.approx(row.reference_value / row.value)
    assert row.core_seconds < row.value  # sleeping needs no core


def test_expensive_jobs_are_repeated_half_as_often():
    benchmark = Benchmark("", "", lambda: None, lambda: None, expensive=True)
    config = TimingConfig(min_repeats=5, max_repeats=3, seconds=0.0)
    assert measure(benchmark, config).repeats == 3


def test_a_row_holds_medians_the_best_time_and_core_time(monkeypatch):
    job, reference = (lambda: None), (lambda: None)
    times = {
        job: iter([(3.0, 1.0), (1.0, 5.0), (2.0, 3.0)]),
        reference: iter([(8.0, 1.0), (9.0, 2.0), (4.0, 5.0)]),
    }
    monkeypatch.setattr(timing, "clocked", lambda called, *_: next(times[called]))
    row = measure(Benchmark("a", "b", job, reference, scale=0.5, reference_scale=2.0), QUICK)
    assert (row.value, row.best, row.core_seconds, row.reference_value) == (1.0, 0.5, 1.5, 16.0)
    assert row.reference_core_seconds == 4.0 and row.ratio == 16.0
    assert row.as_json()["name"] == "a"


def test_cheap_jobs_are_repeated_while_there_is_time():
    benchmark = Benchmark("", "", lambda: None, lambda: None)
    assert measure(benchmark, TimingConfig(min_repeats=2, max_repeats=7, seconds=10.0)).repeats == 7
    assert measure(benchmark, TimingConfig(min_repeats=2, max_repeats=7, seconds=0.0)).repeats == 2


def test_the_processor_time_of_a_job_in_other_processes_is_read_by_its_own_clock():
    seconds = iter(range(0, 100, 7))
    benchmark = Benchmark("", "", lambda: None, lambda: None, processor_time=lambda: next(seconds))
    row = measure(benchmark, QUICK)
    assert (row.core_seconds, row.reference_core_seconds) == (7, 7)


def test_wall_and_core_time_of_a_call():
    wall, core = clocked(lambda: time.sleep(0.02))
    assert wall >= 0.02 > core
