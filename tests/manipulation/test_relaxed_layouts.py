"""Layouts by relaxation: distances, pushes, rows of mugs, crowded boxes."""

from itertools import combinations

import numpy as np
import pytest

from manipulation.footprints import Footprint
from manipulation.packing import pack
from manipulation.relaxed_layouts import Parts, Relaxation, Room, _pushes, relax
from manipulation.types import Box

WIDE = Room(np.array([1.0, 1.0]), 0.01, 0.005)


def square(side, middle=(0.0, 0.0)):
    corners = 0.5 * side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return corners + middle


def parts_of(*shapes, mugs=None):
    footprints = [Footprint(outlines, 0.1) for outlines in shapes]
    return Parts.of([footprints], np.zeros(len(shapes), bool) if mugs is None else np.array(mugs))


def test_the_push_is_the_shortfall_along_the_separating_direction_shared_by_both():
    parts = parts_of((square(0.04),), (square(0.04),))
    places = np.array([[[0.0, 0.0], [0.045, 0.01]]])
    push, violation = _pushes(parts, places, WIDE)
    np.testing.assert_allclose(push[0], [[-0.0025, 0], [0.0025, 0]], atol=1e-7)  # 5 mm apart, 10 asked
    assert violation[0] == pytest.approx(0.005, abs=1e-7)
    apart = np.array([[[0.0, 0.0], [0.051, 0.0]]])
    push, violation = _pushes(parts, apart, WIDE)
    assert not push.any() and violation[0] == 0


def test_outlines_of_one_object_do_not_push_each_other_and_all_of_them_push_others():
    handle = square(0.02, (0.03, 0.0))
    parts = parts_of((square(0.04), handle), (square(0.04),))
    places = np.array([[[0.0, 0.0], [0.065, 0.0]]])  # 5 mm from the handle, 25 from the body
    push, violation = _pushes(parts, places, WIDE)
    np.testing.assert_allclose(push[0], [[-0.0025, 0], [0.0025, 0]], atol=1e-7)
    assert violation[0] == pytest.approx(0.005, abs=1e-7)


def test_walls_push_inwards_by_what_reaches_beyond():
    parts = parts_of((square(0.04),))
    room = Room(np.array([0.1, 0.06]), 0.01, 0.005)
    push, violation = _pushes(parts, np.array([[[0.09, -0.05]]]), room)
    np.testing.assert_allclose(push[0, 0], (-0.01, 0.01), atol=1e-7)
    assert violation[0] == pytest.approx(0.01, abs=1e-7)


def test_pushes_are_the_negative_gradient_of_the_energy():
    """Energy: a quarter of the squares of shortfalls between objects, half of those at walls."""
    rng = np.random.default_rng(3)
    hexagon = 0.03 * np.stack([np.cos(np.arange(6)), np.sin(np.arange(6))], axis=1)
    parts = parts_of((square(0.05), square(0.02, (0.035, 0.0))), (hexagon,), (square(0.03),))
    room = Room(np.array([0.06, 0.06]), 0.02, 0.005)
    places = rng.uniform(-0.04, 0.04, (1, 3, 2))

    def energy(at):
        total = 0.0
        directions, support = parts.directions.astype(float), parts.support[0].astype(float)
        half = len(directions) // 2
        for a, b in parts.pairs.T:
            offset = at[parts.owner[b]] - at[parts.owner[a]]
            gap = (directions @ offset - support[a] - np.roll(support[b], half)).max()
            total += 0.25 * max(room.gap - gap, 0.0) ** 2
        for k, owner in enumerate(parts.owner):
            for direction, limit in zip(((1, 0), (0, 1), (-1, 0), (0, -1)), (*room.half, *room.half)):
                reach = support[k] @ (np.abs(directions @ direction - 1.0) < 1e-6)
                total += 0.5 * max(at[owner] @ direction + reach - limit, 0.0) ** 2
        return total

    push = _pushes(parts, places, room)[0][0]
    for index in np.ndindex(3, 2):
        step = np.zeros((3, 2))
        step[index] = 1e-6
        slope = (energy(places[0] + step) - energy(places[0] - step)) / 2e-6
        assert push[index] == pytest.approx(-slope, abs=2e-5)


def test_mugs_are_pulled_to_their_row_and_others_are_not():
    mug = (square(0.01),)
    parts = parts_of(mug, mug, mug, mug, mugs=[True, True, True, False])
    places = np.array([[[-0.1, 0.0], [0.0, 0.06], [0.1, 0.0], [0.0, -0.3]]])
    push, violation = _pushes(parts, places, WIDE)
    np.testing.assert_allclose(push[0], [[0, 0.015], [0, -0.035], [0, 0.015], [0, 0]], atol=1e-6)
    assert violation[0] == pytest.approx(0.035, abs=1e-6)  # 40 mm off the line, 5 allowed
    violation = relax(parts, places, WIDE, np.random.default_rng(0))[1]
    assert violation[0] < 8e-4
    two = parts_of(mug, mug, mugs=[True, True])
    assert not _pushes(two, places[:, :2], WIDE)[0].any(), "two mugs are always in a row"


@pytest.fixture(scope="module")
def quincunx(shapes):
    """Five cans and a box that holds them only as on a die, where no row of three fits."""
    return [("can", shapes.can(0.033, 0.12))] * 5, Box(size=(0.192, 0.192, 0.08))


def test_a_crowded_box_is_filled_where_rows_from_a_corner_leave_one_out(problem_of, quincunx):
    cans, box = quincunx
    problem = problem_of(*cans, box=box, grasped=True)
    items = list(problem.items.values())
    placements, left_out = pack(items, box, problem.config)
    assert not left_out
    places = np.array([placement.position[:2] for placement in placements]) - box.center
    for first, second in combinations(places, 2):
        assert np.linalg.norm(first - second) >= 0.066 + 0.005 - 0.001
    assert np.abs(places).max() <= 0.096 - 0.033 - 0.008 + 0.001
    assert np.linalg.norm(places, axis=1).min() < 0.02, "one is in the middle"


def test_mugs_stand_in_no_row_where_none_has_room_for_them(problem_of, shapes):
    box, quick = Box(size=(0.25, 0.19, 0.08)), {"gaps": (0.008, 0.005), "n_relaxed": 24, "n_restarts": 1}
    problem = problem_of(*[("mug", shapes.mug(0.038))] * 4, box=box, grasped=True, **quick)
    placements, left_out = pack(list(problem.items.values()), box, problem.config)
    assert not left_out and len({placement.yaws for placement in placements}) == 1


def test_the_same_problem_gives_the_same_layouts_and_a_new_start_others(problem_of, quincunx):
    cans, box = quincunx
    problem = problem_of(*cans, box=box, grasped=True, n_relaxed=24)

    def places(relaxation, **changes):
        layouts = relaxation.layouts(0.005, 0.008, **changes)
        return [np.stack(list(layout.positions.values())) for layout in layouts]

    first, second = Relaxation(problem), Relaxation(problem)
    np.testing.assert_array_equal(places(first), places(second))
    again = places(first, afresh=True)
    assert again and not np.array_equal(again[0], places(second)[0])


def test_relaxed_layouts_are_complete_with_nests_equal_handles_and_counted_releases(shapes, problem_of):
    mugs = [("mug", shapes.mug(radius)) for radius in (0.034, 0.036, 0.038)]
    bowls = [("bowl", shapes.bowl(0.075)), ("bowl", shapes.bowl(0.06, 0.045))]
    problem = problem_of(*mugs, *bowls, ("bottle", shapes.flat_bottle()), grasped=True, n_relaxed=32)
    layouts = list(Relaxation(problem).layouts(0.012, 0.012))
    assert layouts
    for layout in layouts:
        assert set(layout.positions) == set(problem.items) and not layout.left_out
        assert len({layout.yaws[f"mug_{i}"] for i in range(3)}) == 1
        np.testing.assert_array_equal(layout.positions["bowl_3"], layout.positions["bowl_4"])
        assert layout.yaws["bottle_5"] in (0.0, np.pi / 2)
        centres = np.stack([layout.positions[f"mug_{i}"] for i in range(3)])
        across = np.linalg.svd(centres - centres.mean(axis=0))[2][1]
        assert np.abs((centres - centres.mean(axis=0)) @ across).max() <= problem.config.row_width + 0.001
        assert layout.freedom > 0
    assert len({layout.yaws["mug_0"] for layout in layouts}) > 1, "handles of different layouts differ"
