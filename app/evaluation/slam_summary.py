"""Summary of the runs of ``evaluate slam``: tables as in the paper, box plots, completion curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.table import Table

from app.evaluation.statistics import Z_95, paired_difference
from app.runs.report import Report
from app.slam.pictures import new_figure, save_figure

PAPER_APE = {"full": 0.01186, "no_joint": 0.04574, "no_uncertainty": 0.03840}  # [m], means of five scenes
NAMES = {
    "full": "full, objects only",
    "no_joint": "no joint optimisation",
    "no_uncertainty": "no uncertainty",
    "with_plane": "full, with the plane",
    "tsdf": "TSDF fusion, poses given",
}
COLORS = {
    "full": "#0072b2",
    "no_joint": "#e69f00",
    "no_uncertainty": "#cc79a7",
    "with_plane": "#009e73",
    "tsdf": "#7a7f8a",
}


def summarise_slam(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row for each run and statistics for each variant; lengths in metres, ratios in 0..1."""
    rows = [_row(line) for line in lines]
    variants = list(dict.fromkeys(line["variant"] for line in lines))
    summary = {v: _variant([line for line in lines if line["variant"] == v]) for v in variants}
    curves = {
        v: curve_with_band(
            [c for line in lines if line["variant"] == v for c in line.get("completion_by_update", ())]
        )
        for v in variants
        if any("completion_by_update" in line for line in lines if line["variant"] == v)
    }
    fused = [line["tsdf"] for line in lines if "tsdf" in line]
    if fused:
        curves["tsdf"] = curve_with_band([c for entry in fused for c in entry["completion"]])
        last = [curve[-1] for entry in fused for curve in entry["accuracy"] if curve]
        summary["tsdf"] = {"accuracy_median": float(np.median(last)) if last else None, "accuracies": last}
    return {
        "rows": rows,
        "variants": summary,
        "against_full": against_full(lines),
        "completion_by_update": curves,
    }


def against_full(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return paired differences of errors [m] to the full variant, by scene and by object."""
    apes: dict[str, dict[Any, float]] = defaultdict(dict)
    accuracies: dict[str, dict[Any, float]] = defaultdict(dict)
    for line in lines:
        if "ape_mean" in line:
            apes[line["variant"]][line["scene"]] = line["ape_mean"]
        for entry in line.get("objects", ()):
            if "accuracy" in entry:
                accuracies[line["variant"]][line["scene"], entry["true_index"]] = entry["accuracy"]
    return {
        variant: {
            "ape_mean": paired_difference(apes["full"], apes[variant]),
            "accuracy": paired_difference(accuracies["full"], accuracies[variant]),
        }
        for variant in list(apes)
        if variant != "full" and "full" in apes
    }


def _row(line: Mapping[str, Any]) -> dict[str, Any]:
    keys = (
        "scene", "variant", "ape_mean", "ape_rmse", "ape_max", "n_lost", "n_frames", "n_keyframes",
        "n_detected", "tracking_rate", "loop_rate", "stage_seconds", "stage_sums",
        "resident", "seconds", "reason",
    )  # fmt: skip
    row = {key: line.get(key) for key in keys}
    objects = line.get("objects", ())
    measured = [o for o in objects if "accuracy" in o]
    row["n_objects"], row["n_true"] = len(measured), line.get("n_true")
    row["n_wrong_class"] = sum(o["category"] != o["true_category"] for o in measured)
    for name in ("accuracy", "chamfer_l1", "completion"):
        row[name] = float(np.median([o[name] for o in measured])) if measured else None
    row["completion_by_update"] = curve_with_band(line.get("completion_by_update", []))["mean"]
    return row


def _variant(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics of one variant over all scenes."""
    apes = [line["ape_mean"] for line in lines if "ape_mean" in line]
    objects = [o for line in lines for o in line.get("objects", ()) if "accuracy" in o]
    result: dict[str, Any] = {
        "n": len(apes),
        "n_failed": len(lines) - len(apes),
        "ape_mean": float(np.mean(apes)) if apes else None,
        "ape_worst_scene": max(apes, default=None),
        "n_lost": sum(line.get("n_lost", 0) for line in lines),
        "n_objects": len(objects),
        "accuracies": [o["accuracy"] for o in objects],
    }
    for name in ("accuracy", "chamfer_l1", "completion"):
        result[f"{name}_median"] = float(np.median([o[name] for o in objects])) if objects else None
    return result


def curve_with_band(curves: Sequence[Sequence[float]]) -> dict[str, list[float]]:
    """Return mean over objects, normal 95 % interval and number of updated objects after each update.

    Objects with fewer updates keep their last value, so that every mean is over all objects.
    """
    length = max((len(curve) for curve in curves), default=0)
    full = [list(curve) + [curve[-1]] * (length - len(curve)) for curve in curves if len(curve)]
    if not full:
        return {"mean": [], "low": [], "high": [], "n": []}
    values: Float[np.ndarray, "n u"] = np.array(full)
    mean, count = values.mean(axis=0), len(values)
    half = Z_95 * values.std(axis=0, ddof=1) / np.sqrt(count) if count > 1 else np.zeros(length)
    updated = [sum(len(curve) > k for curve in curves) for k in range(length)]
    return {
        "mean": mean.tolist(),
        "low": (mean - half).tolist(),
        "high": np.minimum(mean + half, 1.0).tolist(),
        "n": [float(n) for n in updated],
    }


def slam_tables(report: Report) -> list[Table]:
    """Return tables of the APE by scene and variant, as in the paper's Table 2, and of the surfaces."""
    rows, variants = report.metrics["rows"], report.metrics["variants"]
    scenes = sorted({row["scene"] for row in rows})
    ape = Table(title="mean APE in cm", title_justify="left", show_edge=False, pad_edge=False)
    ape.add_column("")
    for heading in [*(f"scene {s + 1}" for s in scenes), "all", "paper", "frames lost"]:
        ape.add_column(heading, justify="right")
    surfaces = Table(title="surfaces, medians", title_justify="left", show_edge=False, pad_edge=False)
    surfaces.add_column("")
    for heading in ("objects", "accuracy mm", "chamfer-L1 mm", "completion %"):
        surfaces.add_column(heading, justify="right")
    for variant, figures in variants.items():
        name = NAMES.get(variant, variant)
        if "ape_mean" in figures:
            of = {row["scene"]: row["ape_mean"] for row in rows if row["variant"] == variant}
            cells = [_number(of.get(scene), 100, 2) for scene in scenes]
            paper = _number(PAPER_APE.get(variant), 100, 2)
            ape.add_row(name, *cells, _number(figures["ape_mean"], 100, 2), paper, str(figures["n_lost"]))
        surfaces.add_row(
            name,
            str(figures.get("n_objects", len(figures["accuracies"]))),
            _number(figures["accuracy_median"], 1000, 2),
            _number(figures.get("chamfer_l1_median"), 1000, 2),
            _number(figures.get("completion_median"), 100, 1),
        )
    return [ape, surfaces, *_paired_tables(report)]


def _paired_tables(report: Report) -> list[Table]:
    """Return the table of paired differences to the full variant with their intervals."""
    against = report.metrics["against_full"]
    if not against:
        return []
    table = Table(
        title="more than full, means with 95 % intervals",
        title_justify="left",
        show_edge=False,
        pad_edge=False,
    )
    table.add_column("")
    table.add_column("mean APE mm, by scene", justify="right")
    table.add_column("accuracy mm, by object", justify="right")
    for variant, figures in against.items():
        cells = [interval_text(figures[name], 1000) for name in ("ape_mean", "accuracy")]
        table.add_row(NAMES.get(variant, variant), *cells)
    return [table]


def interval_text(difference: Mapping[str, float | None], factor: float) -> str:
    """Format a paired difference and its interval, scaled by a factor."""
    mean, low, high = (difference[key] for key in ("mean", "low", "high"))
    if mean is None or low is None or high is None:
        return ""
    return f"{factor * mean:+.2f} ({factor * low:+.2f} .. {factor * high:+.2f})"


def _number(value: float | None, factor: float, digits: int) -> str:
    return "" if value is None else f"{factor * value:.{digits}f}"


def write_plots(folder: Path, report: Report) -> None:
    """Write ``overview.png``: completion by update, box plots of the accuracy, APE by scene."""
    metrics = report.metrics
    figure = new_figure(16, 5.4)
    left, middle, right = figure.subplots(1, 3)
    for name, curve in metrics["completion_by_update"].items():
        updates = np.arange(1, len(curve["mean"]) + 1)
        left.plot(updates, curve["mean"], color=COLORS[name], marker="o", markersize=4, label=NAMES[name])
        left.fill_between(updates, curve["low"], curve["high"], color=COLORS[name], alpha=0.2)
    left.set_title("completion at 1 cm by update, mean and 95 % band", loc="left")
    left.set_xlabel("times an object was updated")
    left.set_ylim(0, 1.02)
    if metrics["completion_by_update"]:
        left.legend(loc="lower right", frameon=False)
    boxes = {name: v["accuracies"] for name, v in metrics["variants"].items() if v["accuracies"]}
    if boxes:
        drawn = middle.boxplot(
            [1000 * np.array(values) for values in boxes.values()], patch_artist=True, showfliers=False
        )
        for box, name in zip(drawn["boxes"], boxes):
            box.set_facecolor(COLORS[name])
            box.set_alpha(0.6)
        middle.set_xticks(
            range(1, len(boxes) + 1), [NAMES[name].replace(", ", ",\n") for name in boxes], fontsize=8
        )
    middle.set_title("surface accuracy of the objects [mm]", loc="left")
    middle.set_ylim(bottom=0)
    _draw_ape(right, metrics["rows"])
    for axis in (left, middle, right):
        axis.grid(color="#eceef1")
        axis.set_axisbelow(True)
    figure.tight_layout()
    save_figure(figure, folder / "overview.png")


def _draw_ape(axis: Any, rows: Sequence[Mapping[str, Any]]) -> None:
    variants = list(dict.fromkeys(row["variant"] for row in rows))
    width = 0.8 / max(len(variants), 1)
    for k, variant in enumerate(variants):
        own = [row for row in rows if row["variant"] == variant and row["ape_mean"] is not None]
        at = np.array([row["scene"] + 1 for row in own]) + (k - (len(variants) - 1) / 2) * width
        axis.bar(
            at, [100 * row["ape_mean"] for row in own], width, color=COLORS[variant], label=NAMES[variant]
        )
    axis.set_title("mean APE by scene [cm]", loc="left")
    axis.set_xlabel("scene")
    axis.set_xticks(sorted({row["scene"] + 1 for row in rows}))
    if variants:
        axis.legend(frameon=False, fontsize=9)
