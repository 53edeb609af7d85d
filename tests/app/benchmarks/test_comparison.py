"""Comparison of speed tables by ratio."""

import json

import pytest
from rich.console import Console

from app.benchmarks.comparison import compare, compared, comparison_table, stored_ratios
from app.benchmarks.timing import Row
from app.errors import UsageError
from app.runs.report import Report
from perception.errors import InvalidInputError


def row(name, ratio):
    return Row(name, 1.0, "s", "reference", ratio, ratio, 1.0, 1.0, 5, 1.0)


def stored(folder, rows, command="bench"):
    rows = [{"name": name, "ratio": ratio} for name, ratio in rows]
    (folder / "report.json").write_text(json.dumps({"command": command, "metrics": {"rows": rows}}))
    return folder


def test_a_lower_ratio_than_tolerated_is_slower():
    rows = [row("a", 7.4), row("b", 7.6), row("c", 20), row("n", 1)]
    result = compare(rows, {"a": 10, "b": 10, "c": 10, "g": 1}, 0.25)
    verdicts = [(change.name, change.slower) for change in result.changes]
    assert verdicts == [("a", True), ("b", False), ("c", False)]
    assert result.changes[2].speed == 2 and result.new == ("n",) and result.gone == ("g",)


def test_the_report_names_what_became_slower():
    report = Report("bench", 0, success=True, reason="2 rows")
    slow = compared(report, compare([row("a", 1), row("b", 9)], {"a": 2, "b": 9}, 0.25))
    assert not slow.success and slow.reason == "2 rows; 1 of 2 components slower than before: a 0.50 ×"
    same = compared(report, compare([row("a", 2)], {"a": 2}, 0.25))
    assert same.success and same.metrics["comparison"]["changes"][0]["speed"] == 1
    console = Console(width=100)
    with console.capture() as capture:
        console.print(comparison_table(slow))
    assert "0.50 ×" in capture.get()


def test_stored_results_are_read_from_folder_or_file(tmp_path):
    folder = stored(tmp_path, [("a", 2.5)])
    assert stored_ratios(folder) == stored_ratios(folder / "report.json") == {"a": 2.5}


@pytest.mark.parametrize("rows, command", [
    ([("a", 1)], "pack"), ([("a", None)], "bench"), ([("a", -1)], "bench"),
    ([], "bench"), ([("a", "2")], "bench"), ([("a", True)], "bench"), ([(3, 1)], "bench"),
])  # fmt: skip
def test_other_reports_are_refused(tmp_path, rows, command):
    with pytest.raises(UsageError, match="--against"):
        stored_ratios(stored(tmp_path, rows, command))


def test_a_missing_result(tmp_path):
    with pytest.raises(InvalidInputError, match="nothing"):
        stored_ratios(tmp_path / "nothing")
