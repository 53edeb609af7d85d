"""Multi-object renderer against the single-object one, and its Jacobian against finite differences."""

import numpy as np
import pytest

from perception.geometry import se3_exp
from perception.inference.observation import pixel_rays
from perception.rendering.multi_object import PairRenderer, RayPairs, nearest_pair
from perception.rendering.pose import canonical_from_camera
from perception.rendering.renderer import RayBundle, render


@pytest.fixture
def view(cylinders, scenes):
    T = scenes.orbit((0, 0, 0.04), 0.5, 40, 30)
    frame, _, _ = cylinders.look(T)
    u, v = np.meshgrid(np.arange(100, 220, 9), np.arange(60, 180, 9))
    return T, pixel_rays(frame, u.ravel(), v.ravel())


def pairs_of(world, directions, T):
    """Pair every ray with every object."""
    n, k = len(directions), len(world.ids)
    z = [float((np.linalg.inv(T) @ [*world.landmarks[i].state.pose.translation, 1])[2]) for i in world.ids]
    ranges = np.array([(d - 0.1, d + 0.1) for d in z])
    return RayPairs(
        directions, np.repeat(np.arange(n), k), np.tile(np.arange(k), n), ranges, np.full(k, 0.002)
    )


def maps(world, T):
    return np.concatenate([canonical_from_camera(world.landmarks[i].state.pose, T[None]) for i in world.ids])


def test_pairs_agree_with_the_single_object_renderer(cylinders, view):
    T, directions = view
    world = cylinders.map()
    pairs = pairs_of(world, directions, T)
    image = PairRenderer(world.stack, pairs)(maps(world, T))
    for k, id in enumerate(world.ids):
        near, far = pairs.depth_range[k]
        rays = RayBundle(
            directions.astype(np.float32), np.zeros(len(directions), np.int64), pairs.depth_range[[k]], 100
        )
        assert (far - near) / 100 == pytest.approx(pairs.step[k])
        single = render(world.landmarks[id].grid, rays, maps(world, T)[[k]], gradients=False)
        own = pairs.object == k
        apart = np.abs(image.depth[own] - single.depth)  # thresholds of the kernels differ
        assert np.quantile(apart, 0.9) < 2e-4 and apart.max() < 3e-3
        assert np.abs(image.mask[own] - single.mask).max() < 0.02


def test_camera_jacobian_agrees_with_finite_differences(cylinders, view):
    T, directions = view
    world = cylinders.map()
    renderer = PairRenderer(world.stack, pairs_of(world, directions, T))
    analytic = renderer(maps(world, T)).jacobian
    step = 2e-4
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = step
        ahead, behind = (renderer(maps(world, T @ se3_exp(s * xi))).depth for s in (1, -1))
        numeric = (ahead.astype(np.float64) - behind) / (2 * step)
        scale = np.abs(numeric).max()
        assert np.quantile(np.abs(analytic[:, axis] - numeric), 0.97) < 0.03 * scale


def test_the_nearer_object_occludes_the_farther_one():
    pairs = RayPairs(
        np.zeros((3, 3)), np.array([0, 0, 1, 2, 2]), np.array([0, 1, 0, 0, 1]), np.ones((2, 2)), np.ones(2)
    )
    own = np.array([True, False, True, True, False])
    depth, mask = np.array([0.5, 0.4, 0.6, 0.7, 0.3]), np.array([0.9, 0.9, 0.1, 0.9, 0.2])
    # ray 0: object 1 is nearer with a high hit probability; ray 2: nearer with a low one
    assert nearest_pair(pairs, own, depth, mask).tolist() == [1, 2, 3]


def test_without_pairs_nothing_is_rendered(cylinders):
    none = np.zeros(0, np.int64)
    pairs = RayPairs(np.zeros((0, 3)), none, none, np.ones((5, 2)), np.ones(5))
    world = cylinders.map()
    image = PairRenderer(world.stack, pairs)(maps(world, np.eye(4)))
    assert image.depth.shape == (0,) and nearest_pair(pairs, none > 0, image.depth, image.mask).shape == (0,)
