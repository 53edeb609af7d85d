"""Strategies of greedy layouts and their costs."""

import numpy as np
import pytest

from manipulation.footprints import BoxRaster
from manipulation.packing_strategies import (
    Strategy,
    corner_cost,
    greedy_layout,
    line_cost,
    strategies,
    yaws_of,
)
from manipulation.types import Box


def test_without_mugs_only_the_corner_varies(shapes, problem_of):
    found = strategies(problem_of(("can", shapes.can())), 0.008)
    assert {strategy.corner for strategy in found} == {(-1, -1), (-1, 1), (1, -1), (1, 1)} and len(found) == 4


@pytest.mark.parametrize("n_mugs, count", [(1, 8), (2, 8), (3, 10)])
def test_lines_along_the_walls_and_for_three_mugs_along_the_diagonals(shapes, problem_of, n_mugs, count):
    problem = problem_of(*[("mug", shapes.mug())] * n_mugs, n_handle_directions=2)
    found = strategies(problem, 0.01)
    assert len(found) == 2 * count
    assert sorted({strategy.handle_yaw for strategy in found}) == pytest.approx([0, np.pi])


def test_mugs_on_a_wall_line_keep_the_wall_gap_and_others_start_opposite(shapes, problem_of):
    box = Box(size=(0.3, 0.4, 0.08))
    problem = problem_of(("mug", shapes.mug()), box=box, n_handle_directions=1)
    for strategy in strategies(problem, 0.01):
        point = np.array(strategy.line_point)
        axis = int(np.argmax(np.abs(point)))
        wall = np.sign(point) * (np.arange(2) == axis)
        assert strategy.line_direction == ((0, 1) if axis == 0 else (1, 0))
        assert strategy.corner[axis] == -wall[axis]
        reach = problem.shapes.rotated("mug_0", 0.0).reach(wall)
        edge = box.size[axis] / 2 - 0.01
        assert abs(point[axis]) + reach == pytest.approx(edge - problem.cell)


def test_costs_grow_along_the_line_and_away_from_the_corner():
    raster = BoxRaster(Box(size=(0.2, 0.2, 0.08)), 0.0)
    strategy = Strategy((0.0, float(raster.y[3])), (1.0, 0.0), 0.0, (1.0, -1.0))
    on_line = line_cost(raster, strategy)
    assert np.isfinite(on_line[:, 3]).all() and np.isinf(np.delete(on_line, 3, axis=1)).all()
    np.testing.assert_allclose(on_line[:, 3], raster.x)
    cost = corner_cost(raster, strategy.corner)
    assert np.unravel_index(np.argmin(cost), cost.shape) == (len(raster.x) - 1, 0)
    assert cost[0, 0] - cost[-1, 0] == pytest.approx(np.ptp(raster.x))
    assert cost[0, -1] - cost[0, 0] == pytest.approx(1.05 * np.ptp(raster.y))


def test_greedy_layouts_begin_in_the_corner_with_the_widest_and_give_up_early(shapes, problem_of):
    box = Box(size=(0.18, 0.1, 0.08))
    cans = [("can", shapes.can(radius, 0.12)) for radius in (0.025, 0.036, 0.036, 0.030)]
    problem = problem_of(*cans, box=box, grasped=True)
    (strategy,) = (s for s in strategies(problem, 0.008) if s.corner == (-1.0, -1.0))
    empty = BoxRaster(box, 0.008 - 0.005)
    layout = greedy_layout(problem, strategy, 0.005, empty, allowed=4)
    assert set(layout.positions) == {"can_1", "can_2"} and layout.left_out == ["can_3", "can_0"]
    assert layout.positions["can_1"][0] < layout.positions["can_2"][0]
    assert layout.freedom > 0, "releases are counted of what fits"
    early = greedy_layout(problem, strategy, 0.005, empty, allowed=0)
    assert early.left_out == ["can_3"] and early.freedom == 0


def test_only_flat_bottles_are_tried_at_two_yaws(shapes, problem_of):
    kinds = [("bottle", shapes.flat_bottle()), ("bottle", shapes.bottle()), ("bowl", shapes.bowl())]
    flat, round_, bowl = problem_of(*kinds).items.values()
    assert yaws_of(flat) == (0.0, np.pi / 2) and yaws_of(round_) == yaws_of(bowl) == (0.0,)
