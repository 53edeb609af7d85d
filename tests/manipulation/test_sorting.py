from itertools import combinations

import numpy as np
import pytest

from manipulation.errors import PlanningError
from manipulation.footprints import footprint
from manipulation.sorting import SortingConfig, line_yaws, sort_line
from manipulation.standing import to_standing
from manipulation.types import Line


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def outlines(item, placement):
    """Corners of the object's outlines where it is to stand."""
    shape = footprint(item).rotated(placement.yaws[0])
    return [outline + np.array(placement.position[:2]) for outline in shape.outlines]


def apart(first, second):
    """Whether some direction separates two convex outlines (separating axes, finely sampled)."""
    angles = np.linspace(0, 2 * np.pi, 720)
    normals = np.stack([np.cos(angles), np.sin(angles)])
    return bool(((first @ normals).max(axis=0) < (second @ normals).min(axis=0)).any())


@pytest.fixture(scope="module")
def kitchen(shapes):
    return items_of(
        shapes,
        ("mug", shapes.mug()),
        ("bowl", shapes.bowl(radius=0.06, height=0.045)),
        ("bottle", shapes.bottle()),
        ("can", shapes.can()),
        ("mug", shapes.mug(radius=0.043, height=0.1)),
        ("bowl", shapes.bowl(radius=0.075)),
    )


def test_sorted_objects_ascend_on_the_line(kitchen):
    line = Line()
    placements, left_out = sort_line(kitchen, line)
    assert not left_out
    position = {p.name: (np.array(p.position[:2]) - line.start) @ line.direction for p in placements}
    normal = np.array([-line.direction[1], line.direction[0]])
    for placement in placements:
        assert (np.array(placement.position[:2]) - line.start) @ normal == pytest.approx(0, abs=1e-9)
    ascending = sorted(kitchen, key=lambda item: item.size)
    along = [position[item.name] for item in ascending]
    assert along == sorted(along) and along[0] > 0 and along[-1] < line.length
    by_name = {item.name: item for item in kitchen}
    for a, b in combinations(placements, 2):
        for first in outlines(by_name[a.name], a):
            assert all(apart(first, second) for second in outlines(by_name[b.name], b))


def test_handles_stick_out_sideways_of_the_line(kitchen):
    line = Line()
    placements, _ = sort_line(kitchen, line)
    for placement in (p for p in placements if p.name.startswith("mug")):
        handle = np.array([np.cos(placement.yaws[0]), np.sin(placement.yaws[0])])
        assert handle @ line.direction == pytest.approx(0, abs=1e-9)
        assert len(placement.yaws) == 2


def test_short_line_leaves_out_the_widest(kitchen):
    line = Line((0.6, 0.2), (0.6, 0.75))
    placements, left_out = sort_line(kitchen, line, SortingConfig(min_gap=0.03))
    assert set(left_out) == {"bowl_5"}
    assert left_out["bowl_5"].startswith("line too short: 5 of 6 fit on 0.55 m")
    with pytest.raises(PlanningError, match=r"none of 6 objects fits on 0.05 m"):
        sort_line(kitchen, Line((0.6, 0.2), (0.6, 0.25)))
    with pytest.raises(PlanningError, match="no object to sort"):
        sort_line([], line)
    assert len(placements) == 5


def cans(shapes, *heights):
    """Cans of 66 mm diameter."""
    return items_of(shapes, *[("can", shapes.can(0.033, height)) for height in heights])


def along(placement, line):
    return (np.array(placement.position[:2]) - line.start) @ line.direction


def test_low_objects_are_placed_first(shapes):
    items = items_of(
        shapes, ("can", shapes.can(0.033, 0.16)), ("can", shapes.can(0.033, 0.1)), ("bowl", shapes.bowl(0.07))
    )
    assert items[1].size < items[2].size and items[2].top < items[1].top
    placements, _ = sort_line(items, Line())
    assert [placement.name for placement in placements] == ["bowl_2", "can_1", "can_0"]
    positions = {placement.name: along(placement, Line()) for placement in placements}
    assert positions["can_1"] < positions["bowl_2"] < positions["can_0"], "ascending in size"


def test_positions_follow_from_margin_width_and_gap(shapes):
    items = cans(shapes, 0.1, 0.13)
    line = Line((0.2, 0.2), (0.2, 0.7))
    placements, _ = sort_line(items, line, SortingConfig(margin=0.02, max_gap=0.09))
    # 500 mm - 2 * 20 - 2 * 66 leave 328 mm: the gap is limited to 90 mm.
    assert [along(p, line) for p in placements] == pytest.approx(
        [0.02 + 0.033, 0.02 + 0.033 + 0.066 + 0.09], abs=2e-4
    )
    short = Line((0.2, 0.2), (0.2, 0.4))
    placements, _ = sort_line(items, short, SortingConfig(margin=0.02))
    # 200 mm - 2 * 20 - 2 * 66 leave 28 mm, less than the smallest gap of 30 mm: one is excluded.
    assert len(placements) == 1
    placements, _ = sort_line(items, short, SortingConfig(margin=0.018))
    assert [along(p, short) for p in placements] == pytest.approx([0.051, 0.051 + 0.066 + 0.032], abs=4e-4)
    assert all(
        p.position[2] == 0.0 and p.release_height == SortingConfig().release_height for p in placements
    )


def test_line_yaws_of_round_flat_and_handled_objects(shapes):
    mug, can, flat = items_of(
        shapes, ("mug", shapes.mug()), ("can", shapes.can()), ("bottle", shapes.flat_bottle())
    )
    assert line_yaws(mug, 0.3) == pytest.approx((0.3 - np.pi / 2, 0.3 + np.pi / 2))
    assert len(line_yaws(can, 0.3)) == 16
    assert line_yaws(flat, 0.3) == pytest.approx((0.3, 0.3 + np.pi))
