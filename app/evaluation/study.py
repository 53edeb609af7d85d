"""Comparison of the cells of an evaluation of tasks: rates, paired differences, and a plot."""

from __future__ import annotations

import io
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.table import Table

from app.evaluation.cells import Cell
from app.evaluation.statistics import paired_difference, summarise

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_FIGURES = (
    "n_episodes", "n_successes", "success_rate", "success_rate_ci",
    "n_objects", "n_placed", "object_success_rate", "object_success_rate_ci",
    "failures", "simulated_seconds", "wall_seconds",
)  # fmt: skip
_STYLES = {"on": "-", "off": "--"}


def compare_cells(cells: Sequence[Cell], lines: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the rates of each cell, and the difference of its share of placed objects from the first cell's.

    The difference is paired by seed (``paired_difference``).

    Args:
        cells: Cells of the comparison.
        lines: Finished episodes, each with the entries of its ``Cell``.
    """
    rows, first = [], None
    for cell in cells:
        own = [line for line in lines if all(line.get(k) == v for k, v in asdict(cell).items())]
        summary, shares = summarise(own), _shares(own)
        first = shares if first is None else first
        rows.append(
            asdict(cell)
            | {figure: summary[figure] for figure in _FIGURES}
            | {"minus_first": paired_difference(first, shares)}
        )
    return rows


def _shares(lines: Sequence[Mapping[str, Any]]) -> dict[Hashable, float]:
    """Return the share of placed objects of each episode, by seed."""
    return {
        line["seed"]: sum(bool(entry["placed"]) for entry in line["objects"]) / max(len(line["objects"]), 1)
        for line in lines
    }


def study_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the comparison for the terminal."""
    table = Table(title="comparison, paired by seed", title_justify="left", show_edge=False, pad_edge=False)
    for heading in (
        "",
        "episodes complete",
        "objects in place",
        "95 % interval",
        "minus the first",
        "robot time",
    ):
        table.add_column(heading, justify="left" if not heading else "right")
    for row in rows:
        low, high = row["object_success_rate_ci"]
        table.add_row(
            Cell(row["shapes"], row["scan_views"], row["uncertainty"]).name,
            f"{row['n_successes']} of {row['n_episodes']}",
            f"{row['n_placed']} of {row['n_objects']}",
            f"{100 * low:.0f} to {100 * high:.0f} %",
            _difference(row["minus_first"]),
            "" if row["simulated_seconds"] is None else f"{row['simulated_seconds']:.0f} s",
        )
    return table


def _difference(difference: Mapping[str, Any]) -> str:
    if difference["mean"] is None:
        return ""
    return (
        f"{100 * difference['mean']:+.1f} [{100 * difference['low']:.1f}, {100 * difference['high']:.1f}] %"
    )


def study_svg(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Return the shares of placed objects over the images of the scan, with 95 % intervals, as SVG.

    The same rows give the same bytes. A source of shapes that was run with one number of images is a
    horizontal line; if all were run with the same one, they are side by side.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "nodeslam", "svg.fonttype": "none", "font.size": 8}):
        figure = Figure(figsize=(4.2, 3.0), layout="constrained")
        axes = figure.subplots()
        counts = sorted({row["scan_views"] for row in rows})
        if len(counts) == 1:
            _draw_side_by_side(axes, rows)
            axes.set_xlabel(f"shapes, from {counts[0]} image{'s' if counts[0] > 1 else ''}")
        else:
            _draw_curves(axes, rows)
            axes.set_xlabel("images of the scan")
            axes.set_xticks(counts)
            axes.legend(frameon=False, fontsize=7)
        axes.set_ylabel("objects in place [%]")
        axes.grid(alpha=0.3)
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def _draw_side_by_side(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw one point with its interval for each source of shapes."""
    for k, row in enumerate(rows):
        rate, error = _with_interval([row])
        axes.errorbar([k], rate, error, marker="o", ms=4, capsize=3, ls="", color="C0")
    axes.set_xticks(range(len(rows)), [_label(row) for row in rows])
    axes.set_xlim(-0.5, len(rows) - 0.5)


def _draw_curves(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the share over the number of images for each source of shapes."""
    series: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        series.setdefault(_label(row), []).append(row)
    for label, points in series.items():
        rates, error = _with_interval(points)
        if len(points) == 1:
            axes.axhline(rates[0], ls=":", color="0.4", label=f"{label}, {points[0]['scan_views']} images")
            continue
        axes.errorbar(
            [p["scan_views"] for p in points], rates, error,
            marker="o", ms=3, capsize=2, ls=_STYLES[points[0]["uncertainty"]], label=label,
        )  # fmt: skip


def _label(row: Mapping[str, Any]) -> str:
    return row["shapes"] + (", uncertainty off" if row["uncertainty"] == "off" else "")


def _with_interval(points: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[list[float]]]:
    """Return shares in per cent, and how far their intervals reach below and above them."""
    rates = [100 * p["object_success_rate"] for p in points]
    low, high = zip(*(p["object_success_rate_ci"] for p in points), strict=True)
    below = [rate - 100 * a for rate, a in zip(rates, low)]
    return rates, [below, [100 * b - rate for rate, b in zip(rates, high)]]
