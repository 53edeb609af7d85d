"""``nodeslam bench``: times of each stage and of a reference measured in the same run."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from app.benchmarks.comparison import compare, compared, comparison_table, stored_ratios
from app.benchmarks.machine import describe_machine
from app.benchmarks.rows import benchmarks
from app.benchmarks.scene import prepare
from app.benchmarks.timing import Row, TimingConfig, measure
from app.errors import UsageError
from app.options import BenchOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.pipeline import resolve_device
from perception.threads import single_threaded


def run(options: BenchOptions, screen: Screen) -> Report:
    """Time every row; the report is written after each, so that an interruption keeps the finished ones."""
    if options.growth:
        from app.benchmarks.growth import run as run_growth

        if options.scan is not None or options.against is not None:
            raise UsageError("--growth measures scenes of its own: leave out --scan and --against")
        return run_growth(options, screen)
    begin = time.perf_counter()
    device = resolve_device(options.device)
    machine = describe_machine(device)
    before = stored_ratios(options.against) if options.against is not None else {}
    with screen.stage("Preparing a scan of six objects"):
        scene = prepare(options.scan, options.seed, options.device)
    folder = RunFolder.create(options, "bench")
    rows: list[Row] = []
    timing = TimingConfig(min_repeats=options.repeats)
    with screen.stage("Measuring"), single_threaded():
        for benchmark in benchmarks(scene, device, options.seed):
            screen.update(benchmark.name)
            rows.append(measure(benchmark, timing))
            folder.write_report(_report(options, machine, rows, time.perf_counter() - begin, done=False))
    report = _report(options, machine, rows, time.perf_counter() - begin, done=True)
    if options.against is not None:
        report = compared(report, compare(rows, before, options.tolerance))
    folder.write_report(report)
    screen.show(_table(rows))
    if options.against is not None:
        screen.show(comparison_table(report))
    screen.show(escape(_machine_text(machine)))
    return report


def _report(options: BenchOptions, machine: dict, rows: Sequence[Row], seconds: float, done: bool) -> Report:
    busy = machine["load"] > 0.5 * machine["cores"]
    return Report(
        command="bench",
        seed=options.seed,
        success=done,
        reason=f"{len(rows)} rows" + ("" if done else ", not all"),
        timings={"total": seconds},
        metrics={"rows": [row.as_json() for row in rows], "machine": machine},
        warnings=[f"load {machine['load']} on {machine['cores']} cores: ratios are more reliable than times"]
        if busy
        else [],
        settings={"scan": str(options.scan) if options.scan else "simulated", "repeats": options.repeats},
    )


def _table(rows: Sequence[Row]) -> Table:
    title = "nodeslam bench: median times; ratio: how many times as fast as the reference"
    table = Table(title=title, title_justify="left", title_style="", show_edge=False, pad_edge=False)
    for heading in ("", "time", "on cores", "ratio", "to"):
        left = heading in ("", "to")
        table.add_column(heading, justify="left" if left else "right", no_wrap=not left)
    for row in rows:
        times = (_milliseconds(seconds) for seconds in (row.value, row.core_seconds))
        reference = f"{row.reference}: {_milliseconds(row.reference_value)}"
        table.add_row(escape(row.name), *times, f"{row.ratio:.3g} ×", escape(reference))
    return table


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:.2f} ms" if seconds < 0.1 else f"{1e3 * seconds:.0f} ms"


def _machine_text(machine: dict) -> str:
    versions = ", ".join(f"{name} {machine[name]}" for name in ("torch", "onnxruntime", "warp-lang", "numpy"))
    cuda = f", {machine['cuda']}" if machine["cuda"] else ""
    return (
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load']} at the start{cuda}; "
        f"nodeslam {machine['nodeslam']}, python {machine['python']}, {versions}"
    )
