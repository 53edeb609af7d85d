"""Cells of points, and polygons of cells."""

import numpy as np

from perception.support.plan_grid import PlanGrid, convex_hull, values_at

GRID = PlanGrid(np.array([1.0, -1.0], np.float32), 0.5, (3, 4))


def test_points_fall_into_their_cells():
    plan = np.array([[1.1, -0.9], [1.6, -0.9], [2.9, 0.4], [0.9, 0.0], [3.1, 0.0], [1.1, 0.6]], np.float32)
    cells = GRID.cells(plan)
    assert cells.tolist() == [0, 1, 11, -1, -1, -1]
    image = GRID.image(cells)
    assert image.tolist() == [[1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]]
    assert values_at(image, cells).tolist() == [1, 1, 1, 0, 0, 0]


def test_the_grid_around_points_has_the_margin():
    plan = np.array([[0.0, 0.0], [1.0, 2.0]], np.float32)
    grid = PlanGrid.around(plan, 0.1, 0.25)
    assert grid.shape == (25, 15) and (grid.cells(plan) >= 0).all()
    assert (grid.cells(plan + np.float32(0.24)) >= 0).all() and grid.cells(plan - np.float32(0.3))[0] == -1


def test_the_polygon_of_a_hull_is_counterclockwise_and_through_the_middles_of_cells():
    chosen = np.zeros(GRID.shape, bool)
    chosen[0:3, 1:4] = True
    chosen[1, 2] = False
    hull = convex_hull(chosen)
    assert GRID.filled(hull).sum() == 9
    polygon = GRID.polygon(hull)
    assert sorted(map(tuple, polygon.tolist())) == [(1.75, -0.75), (1.75, 0.25), (2.75, -0.75), (2.75, 0.25)]
    for corners in (polygon, GRID.polygon(hull[::-1])):
        x, y = corners.T
        assert np.isclose(0.5 * (x * np.roll(y, -1) - y * np.roll(x, -1)).sum(), 1.0)
