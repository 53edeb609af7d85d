"""Strategies of greedy layouts and their costs."""

import numpy as np
import pytest

from manipulation.footprints import BoxRaster
from manipulation.grasp_config import GraspConfig
from manipulation.nesting import stack_bowls
from manipulation.packing_problem import PackingConfig, PackingProblem, ShapeCache
from manipulation.packing_strategies import Strategy, corner_cost, line_cost, strategies
from manipulation.standing import to_standing
from manipulation.types import Box


def problem_of(shapes, *kinds, box=Box(), **changes):
    """Return the problem of packing objects given as (category, mesh)."""
    items = [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]
    stacks = stack_bowls([item for item in items if item.category == "bowl"])
    cell = BoxRaster(box, 0.0).cell
    by_name = {item.name: item for item in items}
    return PackingProblem(
        by_name, stacks, {}, box, PackingConfig(**changes), GraspConfig(), ShapeCache(items, cell), cell
    )


def test_without_mugs_only_the_corner_varies(shapes):
    found = strategies(problem_of(shapes, ("can", shapes.can())), 0.008)
    assert {strategy.corner for strategy in found} == {(-1, -1), (-1, 1), (1, -1), (1, 1)} and len(found) == 4


@pytest.mark.parametrize("n_mugs, count", [(1, 8), (2, 8), (3, 10)])
def test_lines_along_the_walls_and_for_three_mugs_along_the_diagonals(shapes, n_mugs, count):
    problem = problem_of(shapes, *[("mug", shapes.mug())] * n_mugs, n_handle_directions=2)
    found = strategies(problem, 0.01)
    assert len(found) == 2 * count
    assert sorted({strategy.handle_yaw for strategy in found}) == pytest.approx([0, np.pi])


def test_mugs_on_a_wall_line_keep_the_wall_gap_and_others_start_opposite(shapes):
    box = Box(size=(0.3, 0.4, 0.08))
    problem = problem_of(shapes, ("mug", shapes.mug()), box=box, n_handle_directions=1)
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
    cost = corner_cost(raster, strategy)
    assert np.unravel_index(np.argmin(cost), cost.shape) == (len(raster.x) - 1, 0)
    assert cost[0, 0] - cost[-1, 0] == pytest.approx(np.ptp(raster.x))
    assert cost[0, -1] - cost[0, 0] == pytest.approx(1.05 * np.ptp(raster.y))
