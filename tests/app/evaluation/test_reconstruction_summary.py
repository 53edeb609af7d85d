"""Medians, convergence curves and tables from the rows of a reconstruction evaluation."""

import io

import numpy as np
import pytest
from rich.console import Console

from app.evaluation.reconstruction_summary import PAPER, reconstruction_tables, summarise_reconstruction
from app.options import METHODS
from app.runs.report import Report


def row(name: str, views: int, method: str, accuracy: float, **more) -> dict:
    figures = {"accuracy": accuracy, "chamfer_l1": 2 * accuracy, "completion": 0.9, "seconds": 1.0}
    fields = {"object": name, "category": name[:3], "views": views, "method": method, "found": True}
    return fields | figures | {"status": "converged"} | more


LINES = [
    {
        "object": f"mug_00{k}",
        "rows": [
            row(
                f"mug_00{k}", 1, "full", (0.001, 0.002, 0.006)[k], handle_recall=0.5 * k, handle_visible=k > 0
            ),
            row(f"mug_00{k}", 1, "dvr", 0.01, handle_recall=0.0, handle_visible=k > 0),
        ],
        "convergence": {"full": [[0, 0.02], [8, (0.01, 0.02, 0.06)[k]]], "dvr": [[0, None], [4, 0.02]]},
    }
    for k in range(3)
]


def test_medians_by_class_views_and_method() -> None:
    summary = summarise_reconstruction(LINES)
    full = next(m for m in summary["median"] if m["method"] == "full")
    assert (full["category"], full["views"], full["n"], full["found"]) == ("mug", 1, 3, 1.0)
    assert full["accuracy"] == pytest.approx(0.002) and full["chamfer_l1"] == pytest.approx(0.004)
    assert full["handle_recall"] == pytest.approx(0.5)
    assert full["handle_recall_visible"] == pytest.approx(0.75) and full["n_handle_visible"] == 2
    assert len(summary["rows"]) == 6


def test_objects_not_found_are_counted_and_left_out_of_medians() -> None:
    lost = {
        "object": "mug_003",
        "category": "mug",
        "views": 1,
        "method": "full",
        "found": False,
        "seconds": 0.1,
    }
    summary = summarise_reconstruction([*LINES, {"object": "mug_003", "rows": [lost]}])
    full = next(m for m in summary["median"] if m["method"] == "full")
    assert full["found"] == 0.75 and full["accuracy"] == pytest.approx(0.002)


def test_convergence_holds_the_last_value_and_counts_no_surface_as_far() -> None:
    curves = summarise_reconstruction(LINES)["convergence"]
    assert curves["full"] == {"iteration": [0, 8], "chamfer_l1": pytest.approx([0.02, 0.02])}
    assert curves["dvr"] == {"iteration": [0, 4], "chamfer_l1": [np.inf, 0.02]}


def test_table_shows_the_paper_beside_ours() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    for table in reconstruction_tables(Report("", 0, metrics=summarise_reconstruction(LINES))):
        console.print(table)
    text = console.export_text()
    assert "2.00 (4.46)" in text and "4.00 (4.44)" in text and "90.0 (93.5)" in text
    assert "75" in text and "dvr" in text and "…" not in text


def test_the_papers_methods_are_among_ours() -> None:
    assert set(PAPER) < set(METHODS)


def test_calibration_is_tabulated_for_the_full_method_alone() -> None:
    sure = {"surface_sigma": 0.0012, "within_1_sigma": 0.7, "within_2_sigma": 0.93}
    lines = [
        {"object": "can_000", "rows": [row("can_000", 2, m, 0.001, **sure) for m in ("full", "no_pyramid")]}
    ]
    tables = reconstruction_tables(Report("", 0, metrics=summarise_reconstruction(lines)))
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(tables[-1])
    text = console.export_text()
    assert len(tables) == 2 and tables[-1].row_count == 1
    assert "1.20 mm" in text and "70 %" in text and "93 %" in text and "100 %" in text


def test_resting_poses_are_compared_with_upright() -> None:
    """Of two lying mugs one is taken for upright; the errors of the lying ones are three times as large."""

    def seen(name: str, resting: str, estimated: str, accuracy: float) -> dict:
        more = {"resting": resting, "estimated": estimated, "perceived": "mug"}
        return {"object": name, "rows": [row(name, 1, "full", accuracy, **more)]}

    lines = [seen("mug_000", "upright", "upright", 0.001)]
    lines += [seen(f"mug_00{k}_lying", "lying", pose, 0.003) for k, pose in enumerate(("lying", "upright"))]
    metrics = summarise_reconstruction(lines)
    lying = next(m for m in metrics["median"] if m["resting"] == "lying")
    assert (lying["n"], lying["pose_found"], lying["class_found"]) == (2, 0.5, 1.0)
    report = Report(command="", seed=0, success=True, reason="", timings={}, metrics=metrics)
    console = Console(file=io.StringIO(), width=160)
    for table in reconstruction_tables(report):
        console.print(table)
    (line,) = [text for text in console.file.getvalue().splitlines() if "lying" in text]
    assert line.replace("│", " ").split() == ["mug", "lying", "1", "2", "50", "100", "6.00", "3.00", "90.0"]
