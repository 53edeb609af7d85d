"""Hand-computed rays of the two baseline kernels."""

import numpy as np
import pytest

from perception.rendering.comparison import BACKDROP, render_first_crossing, render_silhouette
from perception.rendering.renderer import RayBundle, ShapeGrid

# Camera at canonical z = -3, looking along +z, 1 m per unit; sample i is at the centre of voxel i - 1.
A = np.hstack([np.eye(3), [[0.0], [0.0], [-3.0]]])[None]
NEAR, FAR, STEP = 2 - 1 / 32, 4 - 1 / 32, 1 / 16
RAY = RayBundle(np.array([[0.0, 0.0, 1.0]]), np.zeros(1, np.int64), np.array([[NEAR, FAR]]), samples=32)


def layers(profile) -> np.ndarray:
    """A grid that is constant in x and y, from its 32 occupancies along z."""
    return np.broadcast_to(np.asarray(profile, np.float32), (32, 32, 32)).copy()


def profile(**occupancy: float) -> np.ndarray:
    line = np.zeros(32, np.float32)
    for name, value in occupancy.items():
        line[int(name[1:])] = value
    return line


def depth_of_layer(k: float) -> float:
    return NEAR + (k + 1) * STEP


def uniform_jacobian(rate: float) -> np.ndarray:
    jacobian = np.zeros((32, 32, 32, 16), np.float32)
    jacobian[..., 3] = rate
    return jacobian


def test_first_crossing_of_a_ramp_and_its_derivatives():
    """0.1, 0.4, 0.8: the level 0.5 is a quarter between the last two; do/dD = 0.4 / voxel = 6.4 / m."""
    shape = ShapeGrid.upload(layers(profile(z9=0.1, z10=0.4, z11=0.8, z12=0.9)), uniform_jacobian(0.3))
    image = render_first_crossing(shape, RAY, A)
    assert image.depth[0] == pytest.approx(depth_of_layer(10.25), abs=1e-5)
    assert image.mask[0] == 1 and image.variance[0] == 0
    assert image.d_code is not None and image.d_map is not None
    assert image.d_code[0, 3] == pytest.approx(-0.3 / 6.4, rel=1e-3)
    assert not image.d_code[0, :3].any()
    expected = np.zeros((4, 3))
    expected[3, 2], expected[2, 2] = -1.0, -depth_of_layer(10.25)  # dz and dz * depth
    np.testing.assert_allclose(image.d_map[0].reshape(4, 3), expected, atol=1e-3)


def test_the_first_of_two_crossings_is_rendered():
    shape = ShapeGrid.upload(layers(profile(z5=0.8, z6=0.1, z20=0.9)))
    assert render_first_crossing(shape, RAY, A).depth[0] == pytest.approx(depth_of_layer(4.625), abs=1e-5)


def test_leaving_an_object_is_no_crossing():
    line = np.where(np.arange(32) < 8, 0.9, 0.1)  # the first sample is inside
    image = render_first_crossing(ShapeGrid.upload(layers(line)), RAY, A)
    assert image.depth[0] == pytest.approx(1.1 * FAR) and image.mask[0] == 0
    assert image.d_map is not None and not image.d_map.any()


def test_occupancy_below_the_level_is_no_surface():
    for peak, mask in ((0.49, 0), (0.51, 1)):
        image = render_first_crossing(ShapeGrid.upload(layers(profile(z9=peak))), RAY, A)
        assert image.mask[0] == mask


def test_curved_crossings_are_refined_by_the_secant_method():
    """Samples every second voxel; the crossing of 0.3, 0.45, 0.9 between them is not on their chord."""
    coarse = RayBundle(RAY.directions, RAY.view, RAY.depth_range, samples=16)
    line = profile(z9=0.3, z10=0.45, z11=0.9, z12=0.9)  # samples at layers 1, 3, ..., 9, 11
    image = render_first_crossing(ShapeGrid.upload(layers(line)), coarse, A)
    assert image.depth[0] == pytest.approx(depth_of_layer(10 + 0.05 / 0.45), abs=1e-4)


def test_the_weight_of_flat_crossings_is_bounded():
    """A slope of 0.01 / voxel counts as 0.02 / voxel = 0.32 / m."""
    line = 0.5 + 0.01 * (np.arange(32) - 15.5)
    image = render_first_crossing(ShapeGrid.upload(layers(line), uniform_jacobian(0.3)), RAY, A)
    assert image.depth[0] == pytest.approx(depth_of_layer(15.5), abs=1e-3)
    assert image.d_code is not None and image.d_code[0, 3] == pytest.approx(-0.3 / 0.32, rel=1e-3)


def test_silhouette_of_three_samples():
    """S = L prod (1 - o_i) = L * 0.8 * 0.5 * 0.75; dS/do_i = -S / (1 - o_i)."""
    shape = ShapeGrid.upload(layers(profile(z3=0.2, z10=0.5, z17=0.25)), uniform_jacobian(1.0))
    image = render_silhouette(shape, RAY, A)
    assert image.depth[0] == pytest.approx(BACKDROP * 0.3, rel=1e-5)
    assert image.mask[0] == pytest.approx(0.7, rel=1e-5) and image.variance[0] == 0
    assert image.d_code is not None
    occupied = -BACKDROP * 0.3 * (1 / 0.8 + 1 / 0.5 + 1 / 0.75)
    assert image.d_code[0, 3] == pytest.approx(occupied, rel=1e-4)  # empty voxels have no derivative


def test_silhouette_derivative_with_respect_to_the_map():
    """Occupancy linear in y: do/dy = 0.05 at each of the 12 samples on the axis."""
    y = np.linspace(-31 / 32, 31 / 32, 32)
    grid = np.broadcast_to((0.2 + 0.05 * y)[None, :, None], (32, 32, 32)).astype(np.float32)
    rays = RayBundle(RAY.directions, RAY.view, np.array([[2.4, 3.6]]), samples=12)
    image = render_silhouette(ShapeGrid.upload(grid), rays, A)
    assert image.d_map is not None
    depths = 2.4 + 0.1 * np.arange(1, 13)
    weight = -BACKDROP * 0.8**12 / 0.8
    rows = image.d_map[0].reshape(4, 3)
    assert rows[3, 1] == pytest.approx(12 * weight * 0.05, rel=1e-3)
    assert rows[2, 1] == pytest.approx(weight * 0.05 * depths.sum(), rel=1e-3)
    assert not rows[:2].any()


def test_opaque_silhouettes_keep_a_derivative():
    """Occupancy 1 is clipped to 0.9999."""
    shape = ShapeGrid.upload(layers(profile(z3=1.0)))
    image = render_silhouette(shape, RAY, A)
    assert image.depth[0] == pytest.approx(1e-4 * BACKDROP, rel=0.01)
    assert image.mask[0] == pytest.approx(0.9999, abs=1e-5)
