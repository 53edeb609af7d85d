"""Charts as HTML and SVG."""

import re
from dataclasses import replace

import numpy as np
import pytest

from app.drawing import CLASS_COLORS
from app.viewer import charts
from app.viewer.snapshot import ObjectOutcome, StageSpan
from app.viewer.timeline import Timeline


def words(html):
    return " ".join(re.sub("<[^>]*>", " ", html).split())


def test_text_from_files_cannot_become_markup(recording):
    evil = "<script>alert(1)</script>"
    assert "<script>" not in charts.header(evil, evil) + charts.stage_bar([], 0.0, evil) + charts.note(evil)
    objects = Timeline(recording).at(recording.now).objects
    left = {0: replace(objects[0], status="not placed", reason=evil)}
    assert "<script>" not in charts.object_table(left, (), {})
    assert "<script>" not in charts.curves(evil, {evil: charts.Curve([0, 1], [2, 1], "can")}, "mm")


def test_the_stage_bar_marks_done_current_and_pending_stages(recording):
    stages = Timeline(recording).stages
    html = charts.stage_bar(stages, stages[2].begin, "caption")
    assert (html.count(charts.GOOD), html.count(charts.ACCENT), html.count(charts.PENDING)) == (2, 1, 3)
    assert html.index(charts.GOOD) < html.index(charts.ACCENT) < html.index(charts.PENDING)
    assert (
        words(html)
        == "Scan 3 s Detect &nbsp; Reconstruct &nbsp; Plan &nbsp; Execute 5 s Verify &nbsp; caption"
    )
    before = charts.stage_bar([StageSpan("scan", 1.0)], 0.9, "")
    assert before.count(charts.PENDING) == 6


def test_the_table_shows_size_score_and_outcome(recording):
    objects = Timeline(recording).at(recording.now).objects
    table = charts.object_table(objects, recording.objects, {0: ObjectOutcome(True, 0.004)})
    assert "can 0 in place, 4 mm from plan" in words(table)
    assert "6.0 × 10.0 cm · score 1.00 · 2 views · residual 1.2 mm" in words(table)
    assert charts.css(CLASS_COLORS["can"]) in table and charts.css(CLASS_COLORS["mug"]) not in table
    assert words(charts.object_table({}, (), {})) == "No object detected yet."


@pytest.mark.parametrize(
    ("changes", "outcome", "expected", "color"),
    [
        ({"status": "placed"}, None, "can 0 placed", charts.FAINT),
        ({"status": "placed"}, ObjectOutcome(False, 0.5), "can 0 placed", charts.FAINT),
        ({"status": "placed"}, ObjectOutcome(True), "can 0 in place", charts.GOOD),
        ({"status": "held"}, ObjectOutcome(True, 0.0), "can 0 held", charts.ACCENT),
        ({"status": "not placed", "reason": "too wide"}, None, "can 0 too wide", charts.BAD),
        ({"status": "not placed"}, None, "can 0 not placed", charts.BAD),
        ({"status": "reconstructed"}, None, "can 0 reconstructed", charts.FAINT),
    ],
)
def test_the_status_has_text_and_colour(recording, changes, outcome, expected, color):
    state = replace(Timeline(recording).at(recording.now).objects[0], residual=None, **changes)
    html = charts.object_table({0: state}, (), {} if outcome is None else {0: outcome})
    assert words(html) == expected and f'<span style="color:{color}">' in html


def test_an_object_during_its_fit_shows_its_iteration(recording):
    state = replace(Timeline(recording).at(recording.now).objects[0], iteration=8, residual=0.002)
    table = words(charts.object_table({0: state}, recording.objects, {}))
    assert "iteration 8 · residual 2.0 mm" in table and "score" not in table


def test_curves_have_the_colour_of_their_class_and_decrease_downwards():
    svg = charts.curves("fit", {"mug_0": charts.Curve([0, 10], [4.0, 2.0], "mug")}, "mm")
    points = np.array([p.split(",") for p in re.findall(r'points="([^"]*)"', svg)[0].split()], dtype=float)
    assert points[0, 0] < points[1, 0] and points[0, 1] < points[1, 1]  # SVG's y axis points down
    # The axis ends at 1.1 times the largest value: 4.4 mm are 130 px.
    np.testing.assert_allclose(points, [(34, 130 * 0.4 / 4.4), (294, 130 * 2.4 / 4.4)], atol=0.06)
    assert charts.css(CLASS_COLORS["mug"]) in svg and "mug 0" in svg
    assert ">4.0<" in svg and ">2.0<" in svg and ">0.0<" in svg  # labels of the axis


def test_plots_without_data_say_so():
    empty = charts.curves("fit", {"mug_0": charts.Curve([], [], "mug")}, "mm")
    assert "polyline" not in empty and "no fit yet" in empty
    assert "no shape code" in charts.bars("code", [0.0, 0.0], "mug")


def test_bars_rise_above_the_axis_for_positive_values():
    svg = charts.bars("code", [1.25, -2.5], "mug")
    rectangles = re.findall(r'<rect x="[\d.]+" y="([\d.]+)" width="[\d.]+" height="([\d.]+)"', svg)
    # The axis is at 50 px; the range is 1.1 times the largest value, 2.75.
    expected = [(50 * (1 - 1.25 / 2.75), 50 * 1.25 / 2.75), (50.0, 50 * 2.5 / 2.75)]
    np.testing.assert_allclose(np.array(rectangles, dtype=float), expected, atol=0.06)


def test_colours_are_hexadecimal_and_the_scale_runs_from_low_to_high():
    assert charts.css((1, 171, 255)) == "#01abff"
    html = charts.color_scale("0", "6 mm", ((0, 0, 0), (255, 0, 0)))
    assert "to right,#000000,#ff0000" in html and words(html) == "0 6 mm"
    legend = charts.legend()
    for category, color in CLASS_COLORS.items():
        assert legend.index(charts.css(color)) < legend.index(f" {category}</span>")
