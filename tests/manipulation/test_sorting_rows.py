"""Rows of sorted objects: unchanged where one line suffices, ascending, apart and within reach otherwise."""

from itertools import combinations, pairwise, product

import numpy as np
import pytest

from manipulation.errors import PlanningError
from manipulation.footprints import footprint
from manipulation.sorting import SortingConfig, sort_line
from manipulation.sorting_rows import AREA, OFFSETS, REACH, further_lines, sort_rows
from manipulation.standing import to_standing
from manipulation.types import Line


@pytest.fixture(scope="module")
def crowd(shapes):
    """Twelve objects: three of each class."""
    meshes = []
    for k in range(3):
        meshes += [
            ("mug", shapes.mug(radius=0.036 + 0.003 * k, height=0.08 + 0.01 * k)),
            ("bowl", shapes.bowl(radius=0.06 + 0.01 * k, height=0.045 + 0.004 * k)),
            ("bottle", shapes.bottle()),
            ("can", shapes.can(0.03 + 0.002 * k, 0.1 + 0.01 * k)),
        ]
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(meshes)]


def corners(item, placement, yaw):
    shape = footprint(item).rotated(yaw)
    return np.concatenate([outline + np.array(placement.position[:2]) for outline in shape.outlines])


def apart(first, second):
    """Whether some direction separates two sets of points."""
    angles = np.linspace(0, 2 * np.pi, 180)
    normals = np.stack([np.cos(angles), np.sin(angles)])
    return bool(((first @ normals).max(axis=0) < (second @ normals).min(axis=0)).any())


def test_one_line_as_long_as_it_suffices(crowd):
    rows = sort_rows(crowd[:4], Line())
    assert rows.lines == (Line(),) and rows.placements == sort_line(crowd[:4], Line())[0]


def test_twelve_objects_ascend_from_row_to_row_without_overlap(crowd):
    rows = sort_rows(crowd, Line())
    assert not rows.left_out and len(rows.placements) == 12 and 2 <= len(rows.lines) <= 3
    items = {item.name: item for item in crowd}

    def rank(placement):
        offsets = [np.array(placement.position[:2]) - line.start for line in rows.lines]
        across = [abs(o @ (-line.direction[1], line.direction[0])) for o, line in zip(offsets, rows.lines)]
        row = int(np.argmin(across))
        assert across[row] < 1e-6
        return row, offsets[row] @ rows.lines[row].direction

    in_order = sorted(rows.placements, key=rank)
    assert all(items[a.name].size <= items[b.name].size for a, b in pairwise(in_order))
    for a, b in combinations(rows.placements, 2):
        for yaw_a in a.yaws[:2]:
            for yaw_b in b.yaws[:2]:
                assert apart(corners(items[a.name], a, yaw_a), corners(items[b.name], b, yaw_b))


def test_other_orders_of_rows_are_tried_when_wide_objects_come_last(shapes):
    """Filled in the order line, near row, far row, the last bowl finds no room on the short far row."""
    meshes = [("mug", shapes.mug(radius=0.04 + 0.003 * k, height=0.08 + 0.01 * k)) for k in range(3)]
    meshes += [("bowl", shapes.bowl(radius=0.082 + 0.004 * k, height=0.06)) for k in range(3)]
    meshes += [("can", shapes.can(0.03 + 0.002 * k, 0.1 + 0.01 * k)) for k in range(2)]
    meshes += [("bottle", shapes.bottle())] * 2
    items = [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(meshes)]
    rows = sort_rows(items, Line())
    assert not rows.left_out and len(rows.placements) == 10
    assert set(rows.lines) - {Line()} and rows.lines[0] != Line()


def test_far_rows_are_filled_first_and_low_objects_first_in_each(crowd):
    rows = sort_rows(crowd, Line())
    items = {item.name: item for item in crowd}

    def distance(placement):
        return max(
            (np.array(line.start) @ (0.4660, 0.8848) for line in rows.lines),
            key=lambda d: -abs(np.array(placement.position[:2]) @ (0.4660, 0.8848) - d),
        )

    keys = [(-round(float(distance(p)), 2), items[p.name].top) for p in rows.placements]
    assert keys == sorted(keys)


def test_further_rows_are_parallel_and_within_reach():
    line = Line()
    rows = [row for offsets in product(*OFFSETS) for row in further_lines(line, offsets)]
    assert len(rows) == 2 * 9
    for row in rows:
        assert abs(row.direction @ line.direction) == pytest.approx(1)
        for end in (row.start, row.end):
            assert REACH[0] - 1e-6 <= np.hypot(*end) <= REACH[1] + 1e-6
            assert all(low <= value <= high for value, (low, high) in zip(end, AREA))


def test_what_fits_on_no_row_is_left_out_with_the_reason(crowd):
    short = Line((0.5, 0.3), (0.3, 0.4))
    rows = sort_rows(crowd, short, SortingConfig(min_gap=0.06))
    assert rows.left_out and len(rows.placements) + len(rows.left_out) == 12
    assert next(iter(rows.left_out.values())).startswith("lines too short: ")
    with pytest.raises(PlanningError, match="none of 12 objects fits"):
        sort_rows(crowd, Line((0.6, 0.2), (0.6, 0.21)))
