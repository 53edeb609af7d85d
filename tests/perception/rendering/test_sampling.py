"""Ray clipping, trilinear interpolation and its derivatives, against NumPy."""

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import map_coordinates

from perception.rendering.sampling import (
    HALF,
    PADDED_VOXELS,
    SIDE,
    SLAB,
    cell_fraction,
    cell_index,
    samples_in_box,
    samples_in_grid,
    trilinear,
    trilinear_gradient,
    trilinear_jacobian,
    vec16,
    voxel_from_canonical,
)
from perception.warp_runtime import launch, to_device, zeros


@wp.kernel
def interpolate_kernel(
    points: wp.array(dtype=wp.vec3),
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    values: wp.array(dtype=wp.float32),
    gradients: wp.array(dtype=wp.vec3),
    rows: wp.array(dtype=vec16),
):
    i = wp.tid()
    p = points[i]
    at = cell_index(p)
    f = cell_fraction(p)
    values[i] = trilinear(occupancy, at, f)
    gradients[i] = trilinear_gradient(occupancy, at, f)
    rows[i] = trilinear_jacobian(jacobian, at, f)


@wp.kernel
def convert_kernel(points: wp.array(dtype=wp.vec3), voxels: wp.array(dtype=wp.vec3)):
    voxels[wp.tid()] = voxel_from_canonical(points[wp.tid()])


@wp.kernel
def clip_kernel(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    near: float,
    far: float,
    step: float,
    samples: int,
    boxes: wp.array(dtype=wp.vec3i),
    in_grid: wp.array(dtype=wp.vec2i),
    in_box: wp.array(dtype=wp.vec2i),
):
    i = wp.tid()
    in_grid[i] = samples_in_grid(origins[i], directions[i], near, far, step, samples)
    in_box[i] = samples_in_box(origins[i], directions[i], near, far, step, samples, boxes, 2)


def interpolated(points, grid, jacobian):
    n = len(points)
    arrays = [zeros(n, dtype, "cpu") for dtype in (wp.float32, wp.vec3, vec16)]
    inputs = [
        to_device(points.astype(np.float32), wp.vec3, "cpu"),
        to_device(grid.astype(np.float32).ravel(), wp.float32, "cpu"),
        to_device(jacobian.astype(np.float32).reshape(-1, 16), vec16, "cpu"),
    ]
    launch(interpolate_kernel, n, inputs, arrays, "cpu")
    return [array.numpy() for array in arrays]


@pytest.fixture(scope="module")
def fields():
    rng = np.random.default_rng(0)
    return rng.random((34, 34, 34)), rng.normal(size=(34, 34, 34, 16)), rng.uniform(0.01, 32.99, (200, 3))


def test_layout_of_the_padded_grid():
    assert (int(SIDE), int(SLAB), float(HALF)) == (34, 34**2, 16.0)
    assert PADDED_VOXELS == 34**3


def test_trilinear_interpolation_of_occupancy_and_jacobian(fields):
    grid, jacobian, points = fields
    values, _, rows = interpolated(points, grid, jacobian)
    np.testing.assert_allclose(values, map_coordinates(grid, points.T, order=1), atol=1e-5)
    expected = np.stack([map_coordinates(jacobian[..., k], points.T, order=1) for k in range(16)], axis=1)
    np.testing.assert_allclose(rows, expected, atol=3e-5)


def test_gradient_of_a_trilinear_polynomial():
    """Trilinear interpolation reproduces f = 1 + 2x - 3y + 5z + 7xy - 11yz + 13zx + 17xyz exactly."""
    x, y, z = np.indices((34, 34, 34)) / 33
    grid = 1 + 2 * x - 3 * y + 5 * z + 7 * x * y - 11 * y * z + 13 * z * x + 17 * x * y * z
    points = np.random.default_rng(1).uniform(0.01, 32.99, (100, 3))
    x, y, z = points.T / 33
    expected = [
        2 + 7 * y + 13 * z + 17 * y * z,
        -3 + 7 * x - 11 * z + 17 * z * x,
        5 - 11 * y + 13 * x + 17 * x * y,
    ]
    _, gradients, _ = interpolated(points, grid, np.zeros((34, 34, 34, 16)))
    np.testing.assert_allclose(33 * gradients, np.transpose(expected), atol=1e-3)


def test_voxel_centres_in_canonical_coordinates():
    """Unpadded voxel k has its centre at canonical -1 + (2k + 1) / 32, and index k + 1 in the padded grid."""
    points = np.array([[-1 + 1 / 32, -1 + 7 / 32, 1 - 1 / 32], [0, 0, 0]])
    voxels = zeros(2, wp.vec3, "cpu")
    launch(convert_kernel, 2, [to_device(points, wp.vec3, "cpu")], [voxels], "cpu")
    np.testing.assert_allclose(voxels.numpy(), [[1, 4, 32], [16.5, 16.5, 16.5]], atol=1e-5)


def clipped(origins, directions, near, far, samples, box):
    n = len(origins)
    in_grid, in_box = (zeros(n, wp.vec2i, "cpu") for _ in range(2))
    step = (far - near) / samples
    boxes = to_device(np.array([[0, 0, 0], [1, 1, 1], *box]), wp.vec3i, "cpu")
    inputs = [
        to_device(origins.astype(np.float32), wp.vec3, "cpu"),
        to_device(directions.astype(np.float32), wp.vec3, "cpu"),
        *(near, far, step, samples, boxes),
    ]
    launch(clip_kernel, n, inputs, [in_grid, in_box], "cpu")
    return in_grid.numpy(), in_box.numpy()


def brute_force(origins, directions, near, far, samples, low, high):
    """First and last index of the samples in the box; (1, 0) if there are none."""
    depths = near + np.arange(1, samples + 1) * (far - near) / samples
    points = origins[:, None] + depths[:, None] * directions[:, None]
    inside = ((points >= low) & (points <= high)).all(-1)
    last = samples - inside[:, ::-1].argmax(1)
    return np.where(inside.any(1)[:, None], np.stack([1 + inside.argmax(1), last], 1), (1, 0))


def test_samples_inside_grid_and_box():
    rng = np.random.default_rng(2)
    origins = np.array([16.5, 16.5, -40.0]) + rng.uniform(-8, 8, (300, 3))
    directions = np.array([0.0, 0.0, 60.0]) + rng.uniform(-25, 25, (300, 3))
    directions[:20, 0] = 0.0  # parallel to a face, inside and outside
    origins[:20, 0] = np.linspace(-5, 40, 20)
    box = ([5, 7, 9], [20, 24, 28])  # cells: voxels 5..21, 7..25, 9..29
    in_grid, in_box = clipped(origins, directions, 0.4, 1.3, 64, box)
    for found, low, high in ((in_grid, 1e-3, 33 - 1e-3), (in_box, np.array(box[0]), np.add(box[1], 1))):
        expected = brute_force(origins, directions, 0.4, 1.3, 64, low, high)
        hit = expected[:, 1] > 0
        assert 30 < hit.sum() < 290
        np.testing.assert_array_equal(found[hit], expected[hit])
        assert (found[~hit, 1] < found[~hit, 0]).all()


def test_an_empty_box_has_no_samples():
    centre = np.full((1, 3), 16.5)
    _, in_box = clipped(centre - [0, 0, 40], np.array([[0.0, 0, 60]]), 0.4, 1.3, 64, ([34] * 3, [-1] * 3))
    assert in_box[0, 1] < in_box[0, 0]


def test_samples_are_counted_from_one_to_the_last():
    """A range that lies inside the grid has all samples, 1..M: the nearest depth itself is no sample."""
    in_grid, _ = clipped(np.full((1, 3), 16.5), np.array([[0.0, 0, 1]]), 1.0, 3.0, 8, ([0] * 3, [32] * 3))
    assert in_grid[0].tolist() == [1, 8]


@pytest.mark.parametrize("slope", [4e-6, -4e-6, 2e-9, 1e-6, 3e38, np.nan, np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("beside", [51.0, -18.0])
def test_rays_beside_the_grid_have_no_samples_however_parallel_they_are(slope, axis, beside):
    """They reach the planes of the faces at depths of millions of metres, if at all."""
    origin, direction = np.full((1, 3), 16.5), np.full((1, 3), 30.0)
    origin[0, axis], direction[0, axis] = beside, slope
    for found in clipped(origin, direction, 0.4, 1.3, 64, ([5] * 3, [20] * 3)):
        assert found[0, 1] < found[0, 0]
    in_grid, _ = clipped(np.full((1, 3), np.nan), direction, 0.4, 1.3, 64, ([5] * 3, [20] * 3))
    assert in_grid[0, 1] < in_grid[0, 0]
