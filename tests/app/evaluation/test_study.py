"""Rates of cells, their paired differences, table and plot."""

import io

import pytest
from rich.console import Console

from app.evaluation.cells import Cell
from app.evaluation.study import compare_cells, study_svg, study_table

CELLS = (Cell("nodeslam", 1, "on"), Cell("nodeslam", 6, "on"), Cell("oracle", 6, "on"))


def line(cell, seed, placed):
    things = [
        {"category": "can", "placed": k < placed, "reason": "" if k < placed else "toppled"} for k in range(4)
    ]
    entry = {"shapes": cell.shapes, "scan_views": cell.scan_views, "uncertainty": cell.uncertainty}
    return {
        "seed": seed,
        "success": placed == 4,
        "reason": "",
        "objects": things,
        "wall_seconds": 1.0,
    } | entry


@pytest.fixture(scope="module")
def rows():
    placed = {CELLS[0]: (3, 2, 3), CELLS[1]: (4, 4, 3), CELLS[2]: (4, 4, 4)}
    lines = [line(cell, seed, n) for cell, counts in placed.items() for seed, n in enumerate(counts)]
    return compare_cells(CELLS, lines)


def test_each_cell_has_its_rates_and_failures(rows):
    assert [(row["n_placed"], row["n_objects"], row["n_successes"]) for row in rows] == [
        (8, 12, 0), (11, 12, 2), (12, 12, 3),
    ]  # fmt: skip
    assert rows[0]["failures"] == {"can: toppled": 4} and rows[2]["failures"] == {}
    assert rows[1]["object_success_rate_ci"][0] < 11 / 12 < rows[1]["object_success_rate_ci"][1]


def test_differences_are_paired_by_seed(rows):
    assert rows[0]["minus_first"]["mean"] == 0.0
    # shares 3/4, 2/4, 3/4 against 4/4, 4/4, 3/4
    assert rows[1]["minus_first"]["mean"] == pytest.approx((1 / 4 + 2 / 4 + 0) / 3)
    assert rows[1]["minus_first"]["n"] == 3


def test_episodes_that_are_not_finished_leave_a_cell_without_a_difference():
    lines = [line(CELLS[0], seed, 4) for seed in (1, 2)] + [line(CELLS[1], 1, 4)]
    rows = compare_cells(CELLS[:2], lines)
    assert rows[1]["minus_first"] == {"mean": None, "low": None, "high": None, "n": 1}


def test_the_table_names_the_cells(rows):
    console = Console(width=140, file=io.StringIO())
    console.print(study_table(rows))
    text = console.file.getvalue()
    assert "nodeslam, 1 view " in text and "oracle, 6 views" in text and "+25.0 [-37.1, 87.1] %" in text, text


def test_the_plot_has_a_curve_for_each_source_and_is_reproducible(rows):
    svg = study_svg(rows)
    assert svg == study_svg(rows)
    assert b"images of the scan" in svg and b"oracle, 6 images" in svg and b"nodeslam" in svg


def test_sources_with_one_number_of_images_are_side_by_side(rows):
    same = [row for row in rows if row["scan_views"] == 6]
    svg = study_svg(same)
    assert b"from 6 images" in svg and b"oracle" in svg and b"nodeslam" in svg
    assert b"oracle, 6 images" not in svg  # no line without an interval
    assert b"from 1 image<" in study_svg([{**row, "scan_views": 1} for row in same])
