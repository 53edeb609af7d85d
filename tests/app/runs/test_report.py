import json

import numpy as np
import pytest

from app.runs.report import ObjectReport, Report, moved_things, package_version


def test_an_object_report_is_flat():
    entry = ObjectReport(3, "mug", False, 0.01, 0.2, 2, "toppled", {"size": 0.1})
    assert entry.as_json() == {
        "id": 3,
        "category": "mug",
        "placed": False,
        "error_position": 0.01,
        "error_tilt": 0.2,
        "attempts": 2,
        "reason": "toppled",
        "size": 0.1,
    }


def test_report_keys_and_rounding():
    report = Report("pack", 7, True, "done", {"scan": 1.23456, "total": 2.0}, settings={"box": "a"})
    content = report.as_json()
    assert list(content) == [
        "command", "seed", "version", "success", "reason", "timings", "objects", "metrics", "warnings",
        "settings",
    ]  # fmt: skip
    assert content["timings"] == {"scan": 1.235, "total": 2.0}
    assert content["version"] == package_version() and content["seed"] == 7 and content["success"] is True


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (np.float32(0.5), 0.5),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (float("nan"), None),
        (np.array([1.0, np.inf]), [1.0, None]),
        ((1, {"a": np.zeros((1, 2))}), [1, {"a": [[0.0, 0.0]]}]),
        ({1: None}, {"1": None}),
    ],
)
def test_metrics_become_plain_json(value, plain):
    text = Report("bench", 0, metrics={"value": value}).to_json()
    assert json.loads(text)["metrics"]["value"] == plain


def test_other_values_become_text(tmp_path):
    settings = Report("scan", 0, settings={"out": tmp_path}).as_json()["settings"]
    assert settings == {"out": str(tmp_path)}


def test_moved_things_are_counted_and_none_is_not_mentioned():
    still, moved = {"moved": False}, {"moved": True}
    assert moved_things([]) == moved_things([still]) == ""
    assert moved_things([still, moved]) == "1 thing of no class moved"
    assert moved_things([moved, moved]) == "2 things of no class moved"
