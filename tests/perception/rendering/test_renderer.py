"""Uploaded grids, ray bundles and hand-computed rays of the probabilistic renderer."""

import numpy as np
import pytest

from perception.rendering.renderer import RayBundle, ShapeGrid, render

# Camera at canonical z = -3, looking along +z, 1 m per unit; sample i is at the centre of voxel i - 1.
A = np.hstack([np.eye(3), [[0.0], [0.0], [-3.0]]])[None]
NEAR, FAR, STEP = 2 - 1 / 32, 4 - 1 / 32, 1 / 16
RAY = RayBundle(np.array([[0.0, 0.0, 1.0]]), np.zeros(1, np.int64), np.array([[NEAR, FAR]]), samples=32)


def slabs(**occupancy: float) -> np.ndarray:
    """Occupancy by layers of constant z: ``z3=0.2`` sets layer 3."""
    grid = np.zeros((32, 32, 32), np.float32)
    for name, value in occupancy.items():
        grid[:, :, int(name[1:])] = value
    return grid


def depth_of_layer(k: int) -> float:
    return NEAR + (k + 1) * STEP


def padded(array) -> np.ndarray:
    return array.numpy().reshape(34, 34, 34)


def test_upload_pads_the_grid_by_one_voxel():
    grid = np.random.default_rng(0).random((32, 32, 32)).astype(np.float32)
    occupancy = padded(ShapeGrid.upload(grid).occupancy)
    np.testing.assert_array_equal(occupancy[1:-1, 1:-1, 1:-1], grid)
    assert occupancy.sum() == pytest.approx(grid.sum(), rel=1e-5)


def test_cells_with_an_occupied_corner_are_flagged():
    grid = np.zeros((32, 32, 32), np.float32)
    grid[4, 10, 20] = 0.3
    shape = ShapeGrid.upload(grid, skip_occupancy=0.29)
    cells = padded(shape.cells)
    assert np.argwhere(cells).min(0).tolist() == [4, 10, 20] and cells.sum() == 8
    assert cells[4:6, 10:12, 20:22].tolist() == np.ones((2, 2, 2)).tolist()
    assert shape.box.numpy().tolist() == [[4, 10, 20], [5, 11, 21]]
    assert not padded(ShapeGrid.upload(grid, skip_occupancy=0.31).cells).any()


def test_cells_with_a_sensitive_corner_are_flagged():
    grid, jacobian = slabs() + np.float32(1e-3), np.zeros((32, 32, 32, 16), np.float32)
    jacobian[8, 8, 8, 5], jacobian[20, 20, 20, 15] = -0.2, 0.05
    shape = ShapeGrid.upload(grid, jacobian, skip_occupancy=0.5, skip_jacobian=0.1)
    assert np.unique(padded(shape.cells)).tolist() == [0, 2] and (padded(shape.cells) == 2).sum() == 8
    assert shape.steppable is not None
    at = [np.ravel_multi_index((k + 1,) * 3, (34,) * 3) for k in (8, 20)]
    assert shape.steppable.numpy().tolist() == at  # both above 1e-4


def test_saturated_voxels_have_no_derivative():
    grid = slabs(z3=1.0, z4=0.5)
    jacobian = np.ones((32, 32, 32, 16), np.float32)
    shape = ShapeGrid.upload(grid, jacobian)
    assert shape.jacobian is not None
    rows = shape.jacobian.numpy().reshape(34, 34, 34, 16)[5, 5]
    assert not rows[4].any() and rows[5].all()


def test_depth_variance_and_mask_of_three_samples():
    """phi = 0.2, 0.4, 0.1 and escape 0.3 at 1.1 FAR; see ``test_reference.py``."""
    image = render(ShapeGrid.upload(slabs(z3=0.2, z10=0.5, z17=0.25)), RAY, A, gradients=False)
    phi = np.array([0.2, 0.4, 0.1, 0.3])
    depths = np.array([depth_of_layer(3), depth_of_layer(10), depth_of_layer(17), 1.1 * FAR])
    mean = phi @ depths
    assert image.depth[0] == pytest.approx(mean, abs=2e-6)
    assert image.variance[0] == pytest.approx(phi @ (depths - mean) ** 2, rel=1e-5)
    assert image.mask[0] == pytest.approx(0.7, abs=1e-6)


def test_jacobian_with_respect_to_the_code_of_three_samples():
    """dD/do_i = T_i (delta_i - E_{i+1}), with the code moving each layer by another amount."""
    layers, occupancy, rate = (3, 10, 17), (0.2, 0.5, 0.25), (1.0, -2.0, 0.5)
    jacobian = np.zeros((32, 32, 32, 16), np.float32)
    for k, layer in enumerate(layers):
        jacobian[:, :, layer, k], jacobian[:, :, layer, 15] = rate[k], 1.0
    grid = slabs(**{f"z{k}": o for k, o in zip(layers, occupancy, strict=True)})
    image = render(ShapeGrid.upload(grid, jacobian), RAY, A)
    expected, weights = 1.1 * FAR, []
    transmittance = (1.0, 0.8, 0.4)
    for T, layer, o in reversed(list(zip(transmittance, layers, occupancy, strict=True))):
        weights.append(T * (depth_of_layer(layer) - expected))
        expected = o * depth_of_layer(layer) + (1 - o) * expected
    weights = weights[::-1]
    assert image.d_code is not None
    np.testing.assert_allclose(image.d_code[0, :3], np.multiply(weights, rate), rtol=1e-5)
    assert image.d_code[0, 15] == pytest.approx(sum(weights), rel=1e-5)
    assert not image.d_code[0, 3:15].any()


def test_jacobian_with_respect_to_the_camera_map():
    """Occupancy 0.1 + 0.05 y: only the map's row y matters; its columns by finite differences."""
    y = np.linspace(-31 / 32, 31 / 32, 32)
    grid = np.broadcast_to((0.1 + 0.05 * y)[None, :, None], (32, 32, 32)).astype(np.float32)
    rays = RayBundle(np.array([[0.05, -0.1, 1.0]]), np.zeros(1, np.int64), np.array([[2.2, 3.6]]), samples=48)
    image = render(ShapeGrid.upload(grid), rays, A)
    assert image.d_map is not None and image.d_code is None
    step = 1e-3
    numeric = []
    for column in range(4):
        moved = [A.copy() for _ in range(2)]
        moved[0][0, 1, column] += step
        moved[1][0, 1, column] -= step
        ahead, behind = (render(ShapeGrid.upload(grid), rays, m, gradients=False).depth[0] for m in moved)
        numeric.append((float(ahead) - float(behind)) / (2 * step))
    rows = image.d_map[0].reshape(4, 3)
    np.testing.assert_allclose(rows[:, 1], numeric, rtol=5e-3, atol=2e-4)
    np.testing.assert_allclose(rows[:, [0, 2]], 0, atol=1e-5)
    np.testing.assert_allclose(rows[:3, 1], rows[2, 1] * rays.directions[0], rtol=1e-5)


def test_rays_end_at_an_opaque_sample():
    image = render(ShapeGrid.upload(slabs(z3=1.0, z4=0.6)), RAY, A, gradients=False)
    assert image.depth[0] == pytest.approx(depth_of_layer(3), abs=1e-6)
    assert image.variance[0] == 0 and image.mask[0] == 1.0


def test_rays_continue_at_a_transmittance_of_one_per_mille():
    image = render(ShapeGrid.upload(slabs(z3=0.999)), RAY, A, gradients=False)
    expected = 0.999 * depth_of_layer(3) + 0.001 * 1.1 * FAR
    assert image.depth[0] == pytest.approx(expected, abs=2e-6)
    assert image.mask[0] == pytest.approx(0.999, abs=1e-6)


def test_missing_rays_have_the_escape_depth_and_no_variance():
    image = render(ShapeGrid.upload(slabs()), RAY, A)
    assert image.depth[0] == pytest.approx(1.1 * FAR) and image.variance[0] == 0 and image.mask[0] == 0
    assert RAY.escape_depth.tolist() == pytest.approx([1.1 * FAR])


def test_rays_are_grouped_by_camera():
    rays = RayBundle(np.ones((5, 3)), np.array([0, 0, 2, 2, 2]), np.tile([1.0, 2.0], (3, 1)), samples=4)
    assert rays.view_slices == (slice(0, 2), slice(2, 2), slice(2, 5))


def test_each_ray_uses_its_own_cameras_map_and_range():
    two = RayBundle(np.tile([[0.0, 0, 1]], (2, 1)), np.arange(2), np.array([[NEAR, FAR], [2.2, 5.0]]), 32)
    maps = np.repeat(A, 2, axis=0)
    maps[1, 2, 3] -= 0.25
    grid = ShapeGrid.upload(slabs(z3=1.0, z4=1.0, z5=1.0, z6=1.0))
    image = render(grid, two, maps, gradients=False)
    assert image.depth[0] == pytest.approx(depth_of_layer(3), abs=1e-6)
    assert image.depth[1] == pytest.approx(depth_of_layer(3) + 0.25, abs=2.8 / 32)
    # the buffers of the rays are reused with other maps
    again = render(grid, two, maps[::-1], gradients=False)
    assert again.depth[0] > image.depth[0] + 0.1


def test_steps_need_a_jacobian():
    with pytest.raises(AssertionError):
        ShapeGrid.upload(slabs()).stepped(np.zeros(16, np.float32))
