import re
from dataclasses import replace

import numpy as np

from app.viewer import charts
from app.viewer.timeline import Story


def words(html):
    return " ".join(re.sub("<[^>]*>", " ", html).split())


def test_text_from_files_cannot_become_markup(recording):
    evil = "<script>alert(1)</script>"
    assert "<script>" not in charts.header(evil, evil) + charts.timeline([], 0.0, evil) + charts.note(evil)
    objects = Story(recording).at(recording.now).objects
    left = {0: replace(objects[0], status="left", reason=evil)}
    assert "<script>" not in charts.object_table(left, (), {})
    assert "<script>" not in charts.curves(evil, {evil: ([0, 1], [2, 1], "can")}, "mm")


def test_the_time_line_marks_where_the_run_is(recording):
    stages = Story(recording).stages
    html = charts.timeline(stages, stages[2].begin + 0.01, "now")
    assert html.count(charts.GOOD) == 2 and html.count(charts.ACCENT) == 1
    assert "Look 3 s" in words(html) and words(html).endswith("now")


def test_the_table_says_size_score_and_status(recording):
    objects = Story(recording).at(recording.now).objects
    table = words(
        charts.object_table(objects, recording.objects, {0: {"placed": True, "error_position": 0.004}})
    )
    assert "can 0 in place, 4 mm from plan" in table
    assert "6.0 × 10.0 cm · score 1.00 · 2 views · residual 1.2 mm" in table
    assert words(charts.object_table({}, (), {})) == "No object has been found yet."


def test_a_curve_ends_where_its_last_value_is():
    svg = charts.curves("fit", {"mug_0": ([0, 10], [4.0, 2.0], "mug")}, "mm")
    points = np.array([p.split(",") for p in re.findall(r'points="([^"]*)"', svg)[0].split()], dtype=float)
    assert points[0, 0] < points[1, 0] and points[0, 1] < points[1, 1]  # down the page is less
    assert charts.curves("fit", {"mug_0": ([], [], "mug")}, "mm").count("polyline") == 0
    assert "nothing has been fitted" in charts.curves("fit", {"mug_0": ([], [], "mug")}, "mm")
    assert "without a code" in charts.bars("code", [0.0, 0.0], "mug")
    assert charts.bars("code", [1.0, -2.0], "mug").count("<rect") == 2
