import io

import numpy as np
import pytest
from rich.console import Console

from app.runs.report import ObjectReport, Report
from app.tables import evaluation_table, fault_table, object_table, resting_table


def text_of(table):
    console = Console(file=io.StringIO(), width=200, color_system=None)
    console.print(table)
    return console.file.getvalue()


def row_of(text, name):
    return next(" ".join(line.replace("│", " ").split()) for line in text.splitlines() if name in line)


def test_object_table():
    report = Report(
        "pack",
        0,
        timings={"total": 31.4},
        objects=[
            ObjectReport(0, "mug", True, 0.0042, float(np.deg2rad(1.26)), 1),
            ObjectReport(-3, "can", False, None, None, 0, "not perceived [at all]"),
        ],
        metrics={"simulated_seconds": 64.2, "reconstruction": [{"id": 0, "accuracy": 0.00154}]},
    )
    text = text_of(object_table(report))
    assert text.startswith("pack: not done, 1 of 2 objects in place in 31 s, 64 s of robot time")
    assert row_of(text, "mug 0") == "✓ mug 0 4 mm 1.3° 1 1.5 mm"
    assert row_of(text, "can (") == "✗ can (not perceived) 0 not perceived [at all]"


@pytest.mark.parametrize(
    ("moved", "said"),
    [((True, False), ", 1 thing of no class moved"), ((True, True), ", 2 things of no class moved")],
)
def test_the_title_says_that_things_of_no_class_were_moved(moved, said):
    rows = [{"moved": each} for each in moved]
    report = Report("sort", 0, timings={"total": 2.0}, metrics={"unknown": rows})
    assert text_of(object_table(report)).startswith(f"sort: not done, 0 of 0 objects in place{said} in 2 s")


def test_title_of_a_success_without_robot_time():
    report = Report("sort", 0, True, timings={"total": 2.0})
    assert (
        text_of(object_table(report)).splitlines()[0].rstrip() == "sort: done, 0 of 0 objects in place in 2 s"
    )


def test_evaluation_table():
    rate = {"success_rate": 0.75, "success_rate_ci": (0.3, 0.954), "n_objects": 4}
    metrics = {
        "success_rate": 0.5, "success_rate_ci": (0.09, 0.91), "n_episodes": 2,
        "object_success_rate": 0.75, "object_success_rate_ci": (0.3, 0.954), "n_objects": 4,
        "per_class": {"mug": rate}, "failures": {"mug: toppled": 1},
    }  # fmt: skip
    text = text_of(evaluation_table(Report("evaluate tasks", 0, reason="2 of 2 episodes", metrics=metrics)))
    assert row_of(text, "episodes complete") == "episodes complete 50 % 9 to 91 % 2"
    assert row_of(text, "objects in place") == "objects in place 75 % 30 to 95 % 4"
    assert row_of(text, "  mug ") == "mug 75 % 30 to 95 % 4"
    assert row_of(text, "toppled") == "1 mug: toppled"
    clean = text_of(evaluation_table(Report("evaluate tasks", 0, metrics=metrics | {"failures": {}})))
    assert "failures" not in clean


def test_perception_by_resting_pose():
    shares = {"n": 4, "found": 0.75, "named": 0.5, "right": 0.5}
    rows = {
        "lying": shares | {"chamfer_l1": 0.0017, "completion": 0.98},
        "upright": shares | {"right": 0.0, "chamfer_l1": None, "completion": None},
    }
    text = text_of(resting_table(rows))
    assert row_of(text, "lying") == "lying 4 75 % 50 % 50 % 1.7 mm 98 %"
    assert row_of(text, "upright") == "upright 4 75 % 50 % 0 %"


def test_outcomes_by_kind_of_fault():
    row = {"n_episodes": 4, "n_complete": 3, "complete_rate_ci": (0.3, 0.954), "n_lost": 1, "n_reported": 0}
    text = text_of(fault_table({"slip": row, "move": row | {"n_complete": 4}}))
    assert row_of(text, "slip") == "slip 4 3 30 to 95 % 1 0 of 1"
    assert row_of(text, "move") == "move 4 4 30 to 95 % 1"
