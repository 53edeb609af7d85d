"""Tables for people."""

from __future__ import annotations

import numpy as np
from rich.markup import escape
from rich.table import Table

from app.report import ObjectReport, Report


def object_table(report: Report) -> Table:
    """What became of each object, and how long it took."""
    seconds = report.timings.get("total", 0.0)
    simulated = report.metrics.get("simulated_seconds")
    robot = f", {simulated:.0f} s of robot time" if simulated else ""
    verdict = "[bold green]done[/bold green]" if report.success else "[bold red]not done[/bold red]"
    n_placed = sum(bool(entry.placed) for entry in report.objects)
    counts = f"{n_placed} of {len(report.objects)} objects in place"
    title = f"{report.command}: {verdict}, {counts} in {seconds:.0f} s{robot}"
    table = Table(title=title, title_justify="left", title_style="", show_edge=False, pad_edge=False)
    for heading, justify in {
        "": "left",
        "object": "left",
        "from plan": "right",
        "tilt": "right",
        "grasps": "right",
        "reconstruction": "right",
        "why not": "left",
    }.items():
        table.add_column(heading, justify=justify, overflow="fold")  # pyright: ignore[reportArgumentType]
    accuracy = {row.get("id"): row.get("accuracy") for row in report.metrics.get("reconstruction", ())}
    for entry in report.objects:
        table.add_row(*_row(entry, accuracy.get(entry.id)))
    return table


def _row(entry: ObjectReport, accuracy: float | None) -> tuple[str, ...]:
    mark = "[green]✓[/green]" if entry.placed else "[red]✗[/red]"
    name = f"{entry.category} {entry.id}" if entry.id >= 0 else f"{entry.category} (unseen)"
    return (
        mark,
        name,
        _millimetres(entry.error_position),
        "" if entry.error_tilt is None else f"{np.rad2deg(entry.error_tilt):.1f}°",
        str(entry.attempts),
        _millimetres(accuracy, digits=1),
        escape(entry.reason),
    )


def _millimetres(length: float | None, digits: int = 0) -> str:
    return "" if length is None else f"{1000 * length:.{digits}f} mm"
