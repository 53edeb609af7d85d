"""The render kernel against the reference renderer and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp

from perception.geometry import rigid, so3_exp
from perception.rendering.kernel import mat34, render_kernel
from perception.rendering.pose import ObjectPose, canonical_from_camera, pose_jacobian
from perception.rendering.reference import render_reference
from perception.rendering.renderer import RayBundle, Rendering, ShapeGrid, render
from perception.rendering.sampling import vec16
from perception.warp_runtime import empty, launch, to_device

POSE = ObjectPose(
    so3_exp(np.array([0.2, -0.1, 0.7])), np.array([0.02, -0.01, 0.03]), np.array([0.05, 0.06, 0.07])
)


def _smooth_noise(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Return random fields on the grid with a correlation length of about four voxels."""
    coarse = torch.from_numpy(rng.normal(size=(1, int(np.prod(shape, dtype=int)), 8, 8, 8)))
    fine = torch.nn.functional.interpolate(coarse, size=32, mode="trilinear", align_corners=True)
    return np.moveaxis(fine[0].numpy(), 0, -1).reshape(32, 32, 32, *shape)


@pytest.fixture(scope="module")
def scene() -> tuple[np.ndarray, np.ndarray, RayBundle, np.ndarray]:
    """A smooth random grid with a random Jacobian, and two cameras at 0.5 m."""
    rng = np.random.default_rng(0)
    grid = 1 / (1 + np.exp(-(2 * _smooth_noise(rng) - 2)))
    jacobian = (grid * (1 - grid))[..., None] * _smooth_noise(rng, 16)
    u, v = np.meshgrid(np.linspace(-0.2, 0.2, 24), np.linspace(-0.2, 0.2, 24))
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=-1)
    view = np.repeat([0, 1], len(pixels))
    depth_range = np.array([[0.4, 0.6], [0.41, 0.62]])
    rays = RayBundle(np.tile(pixels, (2, 1)), view, depth_range, samples=64)
    Ts_world_camera = np.stack(
        [
            rigid(so3_exp(np.array([np.pi, 0, 0])), np.array([0.02, 0.0, 0.52])),
            rigid(so3_exp(np.array([np.pi / 2, 0, 0])), np.array([0.0, 0.5, 0.03])),
        ]
    )
    return grid.astype(np.float32), jacobian.astype(np.float32), rays, Ts_world_camera


def _reference(grid: np.ndarray, rays: RayBundle, A: np.ndarray):
    directions, view = torch.from_numpy(rays.directions), torch.from_numpy(rays.view)
    ranges = torch.from_numpy(rays.depth_range)
    cube = torch.from_numpy(np.asarray(grid, np.float64))
    return render_reference(cube, directions, view, torch.from_numpy(A), ranges, rays.samples)


def _rendered(scene, pose: ObjectPose = POSE, **skip: float) -> tuple[Rendering, np.ndarray]:
    grid, jacobian, rays, cameras = scene
    A = canonical_from_camera(pose, cameras)
    return render(ShapeGrid.upload(grid, jacobian, **skip), rays, A), A


def test_depth_variance_and_mask_agree_with_the_reference(scene) -> None:
    rendering, A = _rendered(scene)
    expected = _reference(scene[0], scene[2], A)
    assert 0.2 < rendering.mask.mean() < 0.99  # the scene has hits and misses
    np.testing.assert_allclose(rendering.depth, expected.depth.numpy(), atol=1e-4)
    np.testing.assert_allclose(rendering.variance, expected.variance.numpy(), atol=1e-5)
    np.testing.assert_allclose(rendering.mask, expected.mask.numpy(), atol=1e-4)


def test_skipping_empty_and_insensitive_cells_changes_the_depth_by_less_than_1_mm(scene) -> None:
    exact, _ = _rendered(scene)
    skipped, _ = _rendered(scene, skip_occupancy=1e-3, skip_jacobian=1e-3)
    np.testing.assert_allclose(skipped.depth, exact.depth, atol=1e-3)


@pytest.mark.parametrize("corner", [(0, 0, 0), (3, 20, 9), (29, 29, 29)])
def test_the_box_bounds_the_occupied_cells(scene, corner) -> None:
    _, _, rays, cameras = scene
    grid, A = np.zeros((32, 32, 32), np.float32), canonical_from_camera(POSE, cameras)
    block = tuple(slice(k, k + 3) for k in corner)
    grid[block] = 0.7
    shape = ShapeGrid.upload(grid)
    # cell indices are those of the lowest voxel in the padded grid
    np.testing.assert_array_equal(shape.box.numpy(), [corner, np.add(corner, 3)])
    image, expected = render(shape, rays, A, gradients=False), _reference(grid, rays, A)
    assert image.mask.max() > 0.5
    np.testing.assert_allclose(image.depth, expected.depth.numpy(), atol=1e-4)
    np.testing.assert_allclose(image.mask, expected.mask.numpy(), atol=1e-4)


def test_empty_grid_escapes_without_gradient(scene) -> None:
    _, _, rays, cameras = scene
    empty = ShapeGrid.upload(np.zeros((32, 32, 32), np.float32), np.zeros((32, 32, 32, 16), np.float32))
    rendering = render(empty, rays, canonical_from_camera(POSE, cameras))
    np.testing.assert_allclose(rendering.depth, rays.escape_depth[rays.view], rtol=1e-6)
    assert not rendering.mask.any() and not rendering.variance.any()
    assert rendering.d_code is not None and not rendering.d_code.any()


def test_code_jacobian_by_finite_differences(scene) -> None:
    grid, jacobian, rays, _ = scene
    rendering, A = _rendered(scene)
    for k in range(16):
        step = 1e-3
        ahead = _reference(grid + step * jacobian[..., k].astype(np.float64), rays, A)
        behind = _reference(grid - step * jacobian[..., k].astype(np.float64), rays, A)
        numeric = (ahead.depth - behind.depth).numpy() / (2 * step)
        assert rendering.d_code is not None
        np.testing.assert_allclose(rendering.d_code[:, k], numeric, atol=2e-4 * np.abs(numeric).max() + 2e-6)


@pytest.mark.parametrize("k", range(9))
def test_pose_jacobian_by_finite_differences(scene, k: int) -> None:
    grid, _, rays, cameras = scene
    rendering, A = _rendered(scene)
    analytic = pose_jacobian(POSE, A, rays, rendering)[:, k]
    step = np.zeros(9)
    step[k] = 1e-6
    ahead, behind = (
        _reference(grid, rays, canonical_from_camera(POSE.moved(s), cameras)).depth.numpy()
        for s in (step, -step)
    )
    numeric = (ahead - behind) / (2 * step[k])
    # Trilinear interpolation has kinks at cell borders: single rays may straddle one.
    error = np.abs(analytic - numeric) / np.abs(numeric).max()
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.99) < 1e-3


def test_several_threads_render_the_same(scene) -> None:
    grid, jacobian, rays, cameras = scene
    A = canonical_from_camera(POSE, cameras)
    shape = ShapeGrid.upload(grid, jacobian)
    alone, shared = render(shape, rays, A), render(shape, replace(rays, threads=3), A)
    for name in ("depth", "variance", "mask", "d_code", "d_map"):
        np.testing.assert_array_equal(getattr(shared, name), getattr(alone, name))


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_rays_than_threads(scene, count: int) -> None:
    grid, jacobian, rays, cameras = scene
    few = replace(rays, directions=rays.directions[:count], view=rays.view[:count], threads=2)
    image = render(ShapeGrid.upload(grid, jacobian), few, canonical_from_camera(POSE, cameras))
    assert image.depth.shape == (count,) and image.d_map is not None and image.d_map.shape == (count, 12)


def test_steps_of_the_code_are_linear_in_the_log_odds(scene) -> None:
    grid, jacobian, _, _ = scene
    step = np.random.default_rng(1).normal(0, 0.1, 16).astype(np.float32)
    stepped = ShapeGrid.upload(grid, jacobian).stepped(step).occupancy.numpy().reshape(34, 34, 34)
    o = np.clip(grid.astype(np.float64), 1e-4, 1 - 1e-4)
    logit = np.log(o / (1 - o)) + jacobian @ step / (o * (1 - o))
    moving = (np.abs(jacobian).max(-1) > 1e-3) & (grid * (1 - grid) > 1e-3)
    assert moving.mean() > 0.1
    expected = 1 / (1 + np.exp(-logit))
    np.testing.assert_allclose(stepped[1:-1, 1:-1, 1:-1][moving], expected[moving], atol=2e-4)
    assert not stepped[0].any() and not stepped[:, :, -1].any()


def test_rendering_without_gradients_gives_the_same_image(scene) -> None:
    grid, _, rays, cameras = scene
    A = canonical_from_camera(POSE, cameras)
    image = render(ShapeGrid.upload(grid), rays, A, gradients=False)
    assert image.d_code is None and image.d_map is None
    np.testing.assert_allclose(image.depth, _rendered(scene)[0].depth, atol=1e-6)
    with pytest.raises(ValueError, match="gradients=True"):
        pose_jacobian(POSE, A, rays, image)


def test_a_launch_as_on_cuda_gives_each_ray_a_stack_of_its_own(scene) -> None:
    """On CUDA one launch renders all rays at once; only then ``stack_stride`` is not zero."""
    grid, jacobian, rays, _ = scene
    n, samples = len(rays.directions), rays.samples
    expected, A = _rendered(scene)
    shape = ShapeGrid.upload(grid, jacobian)
    arrays = [
        to_device(rays.directions, wp.vec3, "cpu"),
        to_device(rays.view, wp.int32, "cpu"),
        to_device(rays.depth_range, wp.vec2, "cpu"),
        to_device(A, mat34, "cpu"),
    ]
    fields = [1, 1, shape.occupancy, shape.jacobian, shape.cells, shape.box]

    def stacks(dim: int, begin: int) -> tuple[np.ndarray, np.ndarray]:
        stack = to_device(np.full((dim * samples, 3), np.nan), wp.vec3, "cpu")
        rows = empty((n, 2), vec16, "cpu")
        launch(render_kernel, dim, [*arrays, samples, samples, begin, stack, *fields], [rows], "cpu")
        return stack.numpy().reshape(dim, samples, 3), rows.numpy()

    together, rows = stacks(n, 0)
    np.testing.assert_array_equal(rows[:, 1, 12], expected.depth)
    np.testing.assert_array_equal(rows[:, 0], expected.d_code)
    assert np.isfinite(together[:, 0, 0]).mean() > 0.2
    for ray in range(0, n, 97):
        np.testing.assert_array_equal(stacks(1, ray)[0][0], together[ray])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_rendering_on_cuda_equals_the_one_on_cpu(scene) -> None:
    grid, jacobian, rays, _ = scene
    on_cpu, A = _rendered(scene)
    on_cuda = render(ShapeGrid.upload(grid, jacobian, "cuda:0"), rays, A)
    for name in ("depth", "variance", "mask", "d_code", "d_map"):
        np.testing.assert_allclose(getattr(on_cuda, name), getattr(on_cpu, name), rtol=1e-3, atol=1e-4)
