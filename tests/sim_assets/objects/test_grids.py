"""Occupancy grids: canonical frame, index order and occupancies of a cylinder in closed form."""

import numpy as np
import pytest

from sim_assets.objects.grids import axis_samples, canonical_frame, sampled_grid, solid_counts, solid_grid
from sim_assets.objects.solids import Handle, Lathe, PolygonSection, Solid

RADIUS, HEIGHT = 0.03, 0.1
CYLINDER = Solid(Lathe(np.array([(0, 0), (RADIUS, 0), (RADIUS, HEIGHT), (0, HEIGHT)])))


def with_handle():
    """A cylinder with a straight bar along +x, 8 mm thick and 12 mm wide, at half its height."""
    bar = np.stack([np.linspace(0.02, 0.06, 21), np.full(21, 0.05)], axis=1)
    handle = Handle(bar, np.full(21, 0.004), np.full(21, 0.006), exponent=2.0)
    core = np.array([(0.02, 0.0), (0.02, HEIGHT)])
    return Solid(CYLINDER.body, handle, core)


def test_canonical_frame_is_centred_and_its_longest_side_is_1_8():
    scale, centre = canonical_frame(np.array([(-1.0, -2.0, 0.0), (3.0, 2.5, 1.0)]))
    assert scale == pytest.approx(4.5 / 1.8)
    np.testing.assert_allclose(centre, (1.0, 0.25, 0.5))


def test_axis_samples_are_voxel_centres():
    np.testing.assert_allclose(axis_samples(4), (-0.75, -0.25, 0.25, 0.75))
    np.testing.assert_allclose(axis_samples(32)[[0, 31]], (-1 + 1 / 32, 1 - 1 / 32))


def test_occupancy_of_a_cylinder():
    grid, counts = solid_grid(CYLINDER), solid_counts(CYLINDER)
    assert grid.dtype == np.float32 and counts.dtype == np.uint8 and counts.max() == 64
    np.testing.assert_array_equal(grid, counts / np.float32(64))
    scale = HEIGHT / 1.8
    x, y, z = np.meshgrid(*[axis_samples(32) * scale] * 3, indexing="ij")
    r, z = np.hypot(x, y), np.abs(z)
    diagonal = np.sqrt(2) * scale / 32  # of half a voxel
    assert (grid[(r < RADIUS - diagonal) & (z < HEIGHT / 2 - scale / 32)] == 1).all()
    assert (grid[(r > RADIUS + diagonal) | (z > HEIGHT / 2 + scale / 32)] == 0).all()
    assert grid.sum() * (2 * scale / 32) ** 3 == pytest.approx(np.pi * RADIUS**2 * HEIGHT, rel=0.01)


def test_index_order_is_x_y_z():
    """The bar lies along +x at half the height, and the origin of z is the base."""
    scale, centre = canonical_frame(with_handle().bounds)
    np.testing.assert_allclose(centre, (0.5 * (0.06 - RADIUS), 0.0, HEIGHT / 2), atol=1e-3)
    grid = solid_grid(with_handle())
    at = np.round(((np.array([0.05, 0.0, 0.05]) - centre) / scale + 1) * 16 - 0.5).astype(int)
    assert grid[tuple(at)] > 0.9
    assert grid[at[0], 0, at[2]] == grid[at[0], at[1], 5] == grid[31 - at[0], at[1], at[2]] * 0 == 0


@pytest.mark.parametrize(
    "solid", [CYLINDER, with_handle(), Solid(Lathe(CYLINDER.body.profile, PolygonSection(4)))]
)
@pytest.mark.parametrize("supersample", [2, 3])
def test_fast_grid_equals_the_grid_of_the_inside_test(solid, supersample):
    fast = solid_grid(solid, 12, supersample)
    slow = sampled_grid(solid.inside, solid.bounds, 12, supersample)
    assert np.abs(fast - slow).max() <= 4 / supersample**3 and np.abs(fast - slow).mean() < 2e-3


def test_sampled_grid_is_the_share_of_supersamples_inside():
    bounds = np.array([(0.0, 0.0, 0.0), (1.8, 1.0, 0.6)])  # canonical unit 1 m, centre (0.9, 0.5, 0.3)
    half = sampled_grid(lambda p: p[:, 0] > 0.9, bounds, 4, 2)
    assert half.dtype == np.float32
    np.testing.assert_array_equal(half[:2], 0.0)
    np.testing.assert_array_equal(half[2:], 1.0)
    corner = sampled_grid(lambda p: (p[:, 1] > 1.25) & (p[:, 2] < 0.3 - 0.75), bounds, 4, 2)
    assert corner[:, 3, 0].min() == 0.25 and corner.sum() == 1.0  # y and z each half a voxel
