import numpy as np
import pytest

from manipulation.footprints import RIM, BoxRaster, Footprint, Stencil, bounding_area, footprint
from manipulation.standing import to_standing
from manipulation.types import Box


def items_of(shapes, *kinds):
    """Standing objects from (category, mesh) pairs."""
    return [to_standing(shapes.estimate(i, category, mesh)) for i, (category, mesh) in enumerate(kinds)]


def test_raster_keeps_walls_and_gaps(shapes):
    (item,) = items_of(shapes, ("can", shapes.can(radius=0.03)))
    raster = BoxRaster(Box(size=(0.2, 0.1, 0.08)), wall_gap=0.005)
    stencil = Stencil.of(footprint(item), 0.01, raster.cell)
    i, j = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).max() == pytest.approx(0.1 - 0.005 - 0.04, abs=0.006)
    assert np.abs(raster.y[j]).max() <= 0.05 - 0.005 - 0.03
    middle = (len(raster.x) // 2, len(raster.y) // 2)
    raster.add(stencil, middle, base=0.004)
    assert raster.highest(np.zeros(2)) == pytest.approx(0.124, abs=1e-3)
    assert raster.highest(np.array([0.104, 0.0])) == pytest.approx(Box().top + RIM)
    assert raster.highest(np.array([5.0, 0.0])) == 0
    i, _ = np.nonzero(raster.free_positions(stencil))
    assert np.abs(raster.x[i]).min(initial=np.inf) >= 0.03 + 0.03


SQUARE = Footprint((np.array([[-0.02, -0.01], [0.03, -0.01], [0.03, 0.01], [-0.02, 0.01]]),), 0.1)


def test_rotation_is_counterclockwise():
    rotated = SQUARE.rotated(np.pi / 2)
    assert rotated.reach(np.array([0.0, 1.0])) == pytest.approx(0.03)
    assert rotated.reach(np.array([0.0, -1.0])) == pytest.approx(0.02)
    assert rotated.reach(np.array([1.0, 0.0])) == pytest.approx(0.01)
    assert rotated.top == SQUARE.top


def test_covered_points_lie_within_the_gap():
    points = np.array([[0.029, 0.0], [0.031, 0.0], [-0.021, 0.0], [0.0, 0.0105]])
    np.testing.assert_array_equal(SQUARE.covers(points), [True, False, False, False])
    np.testing.assert_array_equal(SQUARE.covers(points, 0.0012), [True, True, True, True])


def test_the_wall_gap_keeps_objects_from_the_walls():
    box = Box(size=(0.2, 0.1, 0.08))
    for gap in (0.0, 0.02):
        raster = BoxRaster(box, gap)
        x = raster.centers[..., 0][~raster.taken]
        assert np.abs(x).max() == pytest.approx(0.1 - gap, abs=raster.cell)
        y = raster.centers[..., 1][~raster.taken]
        assert np.abs(y).max() == pytest.approx(0.05 - gap, abs=raster.cell)


def test_heights_of_an_empty_box():
    box = Box(size=(0.2, 0.1, 0.08))
    raster = BoxRaster(box, 0.0)
    assert raster.highest(np.array([0.0, 0.0])) == box.floor
    assert raster.highest(np.array([0.104, 0.0])) == box.top + RIM
    assert raster.highest(np.array([0.13, 0.0])) == 0.0


def test_adding_never_lowers_and_copies_are_independent():
    raster = BoxRaster(Box(), 0.0)
    low, high = (Stencil.of(Footprint(SQUARE.outlines, top), 0.0, raster.cell) for top in (0.05, 0.2))
    cell = (len(raster.x) // 2, len(raster.y) // 2)
    copy = raster.copy()
    raster.add(high, cell, base=0.01)
    raster.add(low, cell)
    assert raster.highest(np.array([0.003, 0.003])) == pytest.approx(0.21)
    assert raster.taken[cell] and not copy.taken[cell]
    assert copy.highest(np.array([0.003, 0.003])) == Box().floor


def test_bounding_area_of_two_footprints():
    area = bounding_area([SQUARE, SQUARE], [np.zeros(2), np.array([0.1, 0.05])])
    assert area == pytest.approx((0.1 + 0.05) * (0.05 + 0.02))
    assert bounding_area([], []) == 0.0
