"""Summary of the rows of ``evaluate reconstruction``, and its tables."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from app.runs.report import Report

Row = Mapping[str, Any]

# NodeSLAM, Table 1, mugs: (accuracy [m], chamfer-L1 [m], completion) by method and views.
PAPER: dict[str, dict[int, tuple[float, float, float]]] = {
    "full": {
        1: (4.459e-3, 4.439e-3, 0.9349),
        2: (3.752e-3, 3.854e-3, 0.9572),
        3: (3.484e-3, 3.648e-3, 0.9607),
    },
    "no_uncertainty": {
        1: (4.998e-3, 4.844e-3, 0.9186),
        2: (4.270e-3, 4.185e-3, 0.9463),
        3: (4.158e-3, 4.010e-3, 0.9517),
    },
    "no_pyramid": {
        1: (4.701e-3, 4.928e-3, 0.9081),
        2: (4.237e-3, 4.723e-3, 0.9075),
        3: (3.827e-3, 4.281e-3, 0.9300),
    },
    "dvr": {
        1: (8.967e-3, 11.896e-3, 0.4308),
        2: (8.408e-3, 11.325e-3, 0.4334),
        3: (8.277e-3, 10.913e-3, 0.4482),
    },
    "mask_only": {
        1: (15.806e-3, 18.386e-3, 0.3021),
        2: (4.709e-3, 4.438e-3, 0.9373),
        3: (4.620e-3, 4.210e-3, 0.9544),
    },
}
FIGURES = ("accuracy", "chamfer_l1", "completion")


def summarise_reconstruction(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return ``metrics`` of the report: all rows, and medians by class, pose, number of views and method."""
    rows = [row for line in lines for row in line["rows"]]
    groups: dict[tuple[str, str, int, str], list[Row]] = defaultdict(list)
    for row in rows:
        groups[row["category"], row.get("resting", "upright"), row["views"], row["method"]].append(row)
    return {
        "rows": rows,
        "median": [
            {"category": category, "resting": resting, "views": views, "method": method} | _medians(entries)
            for (category, resting, views, method), entries in groups.items()
        ],
        "convergence": _convergence(lines),
        "paper": {name: {str(k): dict(zip(FIGURES, v)) for k, v in by.items()} for name, by in PAPER.items()},
    }


def _medians(rows: Sequence[Row]) -> dict[str, Any]:
    """Return medians over the objects found; the bimodal handle recall as a mean."""
    found = [row for row in rows if row["found"]]
    result: dict[str, Any] = {"n": len(rows), "found": len(found) / len(rows)}
    result |= {name: _median(row[name] for row in found) for name in FIGURES}
    result["seconds"] = _median(row["seconds"] for row in found)
    result["converged"] = float(np.mean([row["status"] == "converged" for row in found])) if found else None
    judged = [row for row in found if "estimated" in row]
    if judged:
        right = [row["estimated"] == row.get("resting", "upright") for row in judged]
        result["pose_found"] = sum(right) / len(rows)
        result["class_found"] = sum(row["perceived"] == row["category"] for row in judged) / len(rows)
    calibrated = [row for row in found if "surface_sigma" in row]
    for name in ("surface_sigma", "within_1_sigma", "within_2_sigma"):
        if calibrated:
            result[name] = float(np.mean([row[name] for row in calibrated]))
    handles = [row for row in found if "handle_recall" in row]
    if handles:
        visible = [row["handle_recall"] for row in handles if row["handle_visible"]]
        result["handle_recall"] = float(np.mean([row["handle_recall"] for row in handles]))
        result["handle_recall_visible"] = float(np.mean(visible)) if visible else None
        result["n_handle_visible"] = len(visible)
    return result


def _median(values: Any) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def _convergence(lines: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, list[float]]]:
    """Return by method the median chamfer-L1 of the followed objects at every iteration, in metres."""
    curves: dict[str, list[Sequence[Sequence[Any]]]] = defaultdict(list)
    for line in lines:
        for method, curve in line.get("convergence", {}).items():
            curves[method].append(curve)
    result = {}
    for method, several in curves.items():
        at = sorted({iteration for curve in several for iteration, _ in curve})
        values = np.array([_values_at(curve, at) for curve in several])
        result[method] = {"iteration": at, "chamfer_l1": np.median(values, axis=0).tolist()}
    return result


def _values_at(curve: Sequence[Sequence[Any]], at: Sequence[int]) -> list[float]:
    """Return a curve's last value up to each iteration; infinite where there is no surface."""
    iterations = [iteration for iteration, _ in curve]
    values = [np.inf if value is None else value for _, value in curve]
    return [values[max(int(np.searchsorted(iterations, i, side="right")) - 1, 0)] for i in at]


def reconstruction_tables(report: Report) -> list[Table]:
    """Return one table for each class, with the paper's figures for mugs, and one of the calibration."""
    everything = report.metrics["median"]
    medians = [m for m in everything if m["resting"] == "upright"]
    categories = dict.fromkeys(entry["category"] for entry in medians)
    tables = [_table(category, [m for m in medians if m["category"] == category]) for category in categories]
    calibrated = [m for m in medians if m["method"] == "full" and "surface_sigma" in m]
    tables += [_calibration_table(calibrated)] if calibrated else []
    return [*tables, _pose_table(everything)] if len(medians) < len(everything) else tables


def _pose_table(medians: Sequence[Row]) -> Table:
    """Return the full method by resting pose, with the errors relative to those of upright objects."""
    table = Table(title="resting poses", title_justify="left", show_edge=False, pad_edge=False)
    headings = (
        "",
        "pose",
        "views",
        "n",
        "pose found %",
        "class %",
        "chamfer-L1 mm",
        "of upright",
        "completion %",
    )
    for index, heading in enumerate(headings):
        table.add_column(heading, justify="right" if index > 1 else "left", no_wrap=True)
    full = [m for m in medians if m["method"] == "full"]
    upright = {(m["category"], m["views"]): m["chamfer_l1"] for m in full if m["resting"] == "upright"}
    for entry in full:
        error, reference = entry["chamfer_l1"], upright.get((entry["category"], entry["views"]))
        table.add_row(
            entry["category"],
            entry["resting"],
            str(entry["views"]),
            str(entry["n"]),
            f"{100 * entry.get('pose_found', 0.0):.0f}",
            f"{100 * entry.get('class_found', 0.0):.0f}",
            "–" if error is None else f"{1000 * error:.2f}",
            "–" if error is None or reference is None else f"{error / reference:.2f}",
            "–" if entry["completion"] is None else f"{100 * entry['completion']:.1f}",
        )
    return table


def _calibration_table(medians: Sequence[Row]) -> Table:
    """Return the calibration of the deviations that the full method predicts."""
    title = "calibration: share of the surface within the predicted deviation (ideally 68 and 95 %)"
    table = Table(title=title, title_justify="left", show_edge=False, pad_edge=False)
    for heading in ("", "views", "predicted 1σ", "within 1σ", "within 2σ", "converged"):
        table.add_column(heading, justify="right" if heading else "left")
    for entry in medians:
        shares = (entry["within_1_sigma"], entry["within_2_sigma"], entry["converged"])
        table.add_row(
            entry["category"],
            str(entry["views"]),
            f"{1000 * entry['surface_sigma']:.2f} mm",
            *(f"{100 * share:.0f} %" for share in shares),
        )
    return table


def _table(category: str, medians: Sequence[Row]) -> Table:
    paper = "; paper in brackets" if category == "mug" else ""
    table = Table(
        title=f"{category}: medians of {medians[0]['n']} objects{paper}",
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    for heading in ("views", "method", "accuracy mm", "chamfer-L1 mm", "completion %"):
        table.add_column(heading, justify="left" if heading == "method" else "right", no_wrap=True)
    if category == "mug":
        table.add_column("handle %", justify="right")  # from one view: of the visible handles
    before = None
    for entry in sorted(medians, key=lambda m: m["views"]):
        views = str(entry["views"]) if entry["views"] != before else ""
        table.add_section() if views and before is not None else None
        before = entry["views"]
        table.add_row(views, entry["method"].replace("_", " "), *_cells(entry, category == "mug"))
    return table


def _cells(entry: Row, with_paper: bool) -> list[str]:
    paper = PAPER.get(entry["method"], {}).get(entry["views"]) if with_paper else None
    factors, digits = (1000, 1000, 100), (2, 2, 1)
    cells = []
    for index, name in enumerate(FIGURES):
        factor, form = factors[index], f".{digits[index]}f"
        value = "–" if entry[name] is None else format(factor * entry[name], form)
        cells.append(value + (f" [dim]({format(factor * paper[index], form)})[/dim]" if paper else ""))
    if with_paper:
        recall = entry.get("handle_recall_visible" if entry["views"] == 1 else "handle_recall")
        cells.append("–" if recall is None else f"{100 * recall:.0f}")
    return cells
