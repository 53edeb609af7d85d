"""Result tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from app.runs.report import ObjectReport, Report, moved_things


def object_table(report: Report) -> Group:
    """Return one line with the verdict and the times of the episode, and the outcome of each object.

    The line is not the title of the table, which would be wrapped at the table's width.
    """
    seconds = report.timings.get("total", 0.0)
    simulated = report.metrics.get("simulated_seconds")
    robot = f", {simulated:.0f} s of robot time" if simulated else ""
    verdict = "[bold green]done[/bold green]" if report.success else "[bold red]not done[/bold red]"
    n_placed = sum(bool(entry.placed) for entry in report.objects)
    counts = f"{n_placed} of {len(report.objects)} objects in place"
    moved = moved_things(report.metrics.get("unknown", ()))
    facts = ", ".join(filter(None, (verdict, counts, moved)))
    line = f"{report.command}: {facts} in {seconds:.0f} s{robot}"
    table = Table(show_edge=False, pad_edge=False)
    for heading, justify in {
        "": "left",
        "object": "left",
        "from plan": "right",
        "tilt": "right",
        "grasps": "right",
        "reconstruction": "right",
        "reason": "left",
    }.items():
        table.add_column(heading, justify=justify, overflow="fold")  # pyright: ignore[reportArgumentType]
    accuracy = {row.get("id"): row.get("accuracy") for row in report.metrics.get("reconstruction", ())}
    for entry in report.objects:
        table.add_row(*_row(entry, accuracy.get(entry.id)))
    return Group(line, table)


def _row(entry: ObjectReport, accuracy: float | None) -> tuple[str, ...]:
    mark = "[green]✓[/green]" if entry.placed else "[red]✗[/red]"
    name = f"{entry.category} {entry.id}" if entry.id >= 0 else f"{entry.category} (not perceived)"
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


def evaluation_table(report: Report) -> Group:
    """Return success rates with confidence intervals by class, and the counts of failure reasons."""
    metrics = report.metrics
    rates = Table(title=f"{report.reason}", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("", "rate", "95 % interval", "of"):
        rates.add_column(heading, justify="left" if not heading else "right")
    rows = {"episodes complete": (metrics["success_rate"], metrics["success_rate_ci"], metrics["n_episodes"])}
    rows["objects in place"] = (
        metrics["object_success_rate"],
        metrics["object_success_rate_ci"],
        metrics["n_objects"],
    )
    for name, entry in metrics["per_class"].items():
        rows[f"  {name}"] = (entry["success_rate"], entry["success_rate_ci"], entry["n_objects"])
    for name, (rate, (low, high), count) in rows.items():
        rates.add_row(name, f"{100 * rate:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %", str(count))
    reasons = Table(title="failures", title_justify="left", show_edge=False, pad_edge=False)
    reasons.add_column("count", justify="right")
    reasons.add_column("reason", overflow="fold")
    for reason, count in metrics["failures"].items():
        reasons.add_row(str(count), escape(reason))
    parts = [rates]
    if metrics["failures"]:
        parts += ["", reasons]
    if len(metrics.get("resting", ())) > 1:
        parts += ["", resting_table(metrics["resting"])]
    if metrics.get("faults"):
        parts += ["", fault_table(metrics["faults"])]
    return Group(*parts)


def resting_table(resting: Mapping[str, Any]) -> Table:
    """Return how objects were perceived by how they rested."""
    table = Table(title="perceived", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("", "objects", "found", "class right", "pose too", "chamfer-L1", "completion"):
        table.add_column(heading, justify="left" if not heading else "right")
    for name, row in resting.items():
        shares = [f"{100 * row[key]:.0f} %" for key in ("found", "named", "right")]
        completion = "" if row["completion"] is None else f"{100 * row['completion']:.0f} %"
        table.add_row(name, str(row["n"]), *shares, _millimetres(row["chamfer_l1"], 1), completion)
    return table


def fault_table(faults: Mapping[str, Any]) -> Table:
    """Return the outcomes by kind of fault."""
    table = Table(title="faults", title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("", "episodes", "complete", "95 % interval", "of these lost", "others reported"):
        table.add_column(heading, justify="left" if not heading else "right")
    for kind, row in faults.items():
        low, high = row["complete_rate_ci"]
        n_failed = row["n_episodes"] - row["n_complete"]
        table.add_row(
            kind,
            str(row["n_episodes"]),
            str(row["n_complete"]),
            f"{100 * low:.0f} to {100 * high:.0f} %",
            str(row["n_lost"]),
            f"{row['n_reported']} of {n_failed}" if n_failed else "",
        )
    return table
