"""Comparison of a speed table with a stored one: what became slower, and what is new or gone.

Ratios to the references are compared, not times: job and reference are timed alternately in one run, so that
their ratio is the same on a busy machine and, roughly, on another one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from rich.markup import escape
from rich.table import Table

from app.benchmarks.timing import Row
from app.errors import UsageError
from app.runs.report import Report
from perception.io.files import read_json

REMEDY = "give report.json of nodeslam bench, or its folder"


class _StoredRow(msgspec.Struct):
    name: str
    ratio: float


class _StoredMetrics(msgspec.Struct):
    rows: Annotated[list[_StoredRow], msgspec.Meta(min_length=1)]


class _Stored(msgspec.Struct):
    command: Literal["bench"]
    metrics: _StoredMetrics


@dataclass(frozen=True)
class Change:
    """A component in both tables.

    Attributes:
        name: Description of the job.
        before: Ratio to the reference in the stored table.
        after: Ratio to the reference now.
        speed: ``after`` over ``before``; below 1 if the component became slower.
        slower: Whether it became slower by more than the tolerance.
    """

    name: str
    before: float
    after: float
    speed: float
    slower: bool


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison.

    Attributes:
        changes: Components in both tables, the slowest relative to before first.
        new: Components that the stored table lacks.
        gone: Components that only the stored table has.
    """

    changes: tuple[Change, ...]
    new: tuple[str, ...]
    gone: tuple[str, ...]

    @property
    def slower(self) -> tuple[Change, ...]:
        return tuple(change for change in self.changes if change.slower)


def stored_ratios(path: Path) -> dict[str, float]:
    """Return the ratio of each row of a stored report.

    Raises:
        UsageError: The file is not the report of a benchmark.
        InvalidInputError: The file is missing or no JSON.
    """
    report = read_json(path / "report.json" if path.is_dir() else path, REMEDY)
    try:
        stored = msgspec.convert(report, _Stored)
    except msgspec.ValidationError:
        raise UsageError(f"--against {path} is not the report of a benchmark: {REMEDY}") from None
    ratios = {row.name: row.ratio for row in stored.metrics.rows}
    if not all(0 < ratio < float("inf") for ratio in ratios.values()):
        raise UsageError(f"--against {path} has ratios that are not positive: {REMEDY}")
    return ratios


def compare(rows: Sequence[Row], before: Mapping[str, float], tolerance: float) -> Comparison:
    """Compare a table with the ratios of a stored one.

    Args:
        rows: The table.
        before: Stored ratios by name.
        tolerance: Share of its speed that a component may lose.
    """
    now = {row.name: row.ratio for row in rows}
    changes = [
        Change(name, before[name], ratio, ratio / before[name], ratio < (1 - tolerance) * before[name])
        for name, ratio in now.items()
        if name in before
    ]
    return Comparison(
        tuple(sorted(changes, key=lambda change: change.speed)),
        tuple(name for name in now if name not in before),
        tuple(name for name in before if name not in now),
    )


def compared(report: Report, comparison: Comparison) -> Report:
    """Return the report with the comparison; it fails if something became slower."""
    slower = comparison.slower
    reason = f"{len(slower)} of {len(comparison.changes)} components slower than before"
    if slower:
        reason += ": " + ", ".join(f"{change.name} {change.speed:.2f} ×" for change in slower)
    return replace(
        report,
        success=report.success and not slower,
        reason=f"{report.reason}; {reason}",
        metrics={**report.metrics, "comparison": asdict(comparison)},
    )


def comparison_table(report: Report) -> Table:
    """Return the comparison of a report as a table."""
    table = Table(title="Ratios before and after", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("", "before", "after", "speed", "new or gone"):
        table.add_column(heading, justify="left" if heading in ("", "new or gone") else "right")
    comparison = report.metrics["comparison"]
    for change in comparison["changes"]:
        figures = (f"{change['before']:.3g} ×", f"{change['after']:.3g} ×", f"{change['speed']:.2f} ×")
        style = "bold red" if change["slower"] else None
        table.add_row(escape(change["name"]), *figures, "", style=style)
    for kind in ("new", "gone"):
        for name in comparison[kind]:
            table.add_row(escape(name), "", "", "", kind)
    return table
