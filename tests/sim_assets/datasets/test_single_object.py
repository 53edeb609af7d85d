"""Single-object views: the whole object is visible in every view, at its true pose."""

from dataclasses import replace

import numpy as np
import pytest

from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.single_object import SingleObjectConfig, _random_camera, render_single_object
from sim_assets.objects import sample_object

EXACT = SingleObjectConfig(width=160, height=120, depth_noise="none")


@pytest.fixture(scope="module")
def bottle():
    return sample_object("bottle", "test", np.random.default_rng(3))


@pytest.fixture(scope="module")
def views(bottle):
    return render_single_object(bottle, 3, np.random.default_rng(5), EXACT)


def points_above_table(frame):
    v, u = np.nonzero(frame.depth > 0)
    z, k, T = frame.depth[v, u].astype(np.float64), frame.intrinsics, frame.T_world_camera
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]
    high = (points[:, 2] > 0.005) & (np.abs(points[:, :2]).max(axis=1) < 0.5)
    return points[high], u[high], v[high]


def test_object_is_fully_visible_at_its_true_pose(bottle, views):
    for frame in views.frames:
        points, u, v = points_above_table(frame)
        assert len(points) > 100
        assert min(u.min(), v.min()) > 0 and u.max() < 159 and v.max() < 119
        local = (points - views.T_world_object[:3, 3]) @ views.T_world_object[:3, :3]
        low, high = bottle.mesh.bounds
        assert (local > low - 0.002).all() and (local < high + 0.002).all()
        assert local[:, 2].max() > 0.9 * bottle.height


def test_masks_cover_the_object_and_nothing_else(views):
    for frame, mask in zip(views.frames, views.masks):
        _, u, v = points_above_table(frame)
        assert mask[v, u].all() and mask.sum() < 1.2 * len(u)


def test_same_seed_same_views(bottle, views):
    again = render_single_object(bottle, 3, np.random.default_rng(5), EXACT)
    np.testing.assert_array_equal(again.frames[1].depth, views.frames[1].depth)
    np.testing.assert_array_equal(again.frames[1].rgb, views.frames[1].rgb)
    assert not np.array_equal(views.frames[0].depth, views.frames[1].depth)


def test_depth_noise_and_field_of_view_are_those_of_the_configuration(bottle, views):
    noisy = render_single_object(bottle, 1, np.random.default_rng(5), replace(EXACT, depth_noise="gaussian"))
    error = noisy.frames[0].depth - views.frames[0].depth
    assert np.std(error[views.frames[0].depth > 0]) == pytest.approx(0.002, rel=0.1)
    wide = render_single_object(bottle, 1, np.random.default_rng(5), replace(EXACT, fovy=60.0))
    assert wide.frames[0].intrinsics.fy == pytest.approx(60 / np.tan(np.radians(30)))
    assert views.frames[0].intrinsics.fy == pytest.approx(60 / np.tan(np.radians(22.5)))


@pytest.mark.parametrize(("longest", "factor"), [(0.05, 1.0), (0.1, 1.0), (0.225, 1.5)])
def test_camera_stands_farther_from_longer_objects_and_aims_at_their_middle(longest, factor):
    rng = np.random.default_rng(0)
    config = SingleObjectConfig(off_centre=0.0)
    middle = np.array([0.1, -0.05, 0.06])
    for _ in range(20):
        T = _random_camera(PlanarPose(0.1, -0.05, 1.0), 0.12, longest, config, rng)
        away = T[:3, 3] - middle
        distance = np.linalg.norm(away)
        assert 0.4 * factor <= distance <= 0.7 * factor
        np.testing.assert_allclose(T[:3, 2], -away / distance, atol=1e-12)
        assert config.elevation[0] <= np.arcsin(away[2] / distance) <= config.elevation[1]


def test_a_lying_object_is_rendered_in_its_pose(bottle):
    T_rest = np.eye(4)
    T_rest[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T_rest[2, 3] = np.asarray(bottle.mesh.vertices)[:, 0].max()
    views = render_single_object(bottle, 1, np.random.default_rng(5), EXACT, T_rest)
    points, _, _ = points_above_table(views.frames[0])
    assert abs(views.T_world_object[2, 2]) < 1e-9
    assert points[:, 2].max() == pytest.approx(np.ptp(np.asarray(bottle.mesh.vertices)[:, 0]), abs=0.004)
    local = (points - views.T_world_object[:3, 3]) @ views.T_world_object[:3, :3]
    low, high = bottle.mesh.bounds
    assert (local > low - 0.002).all() and (local < high + 0.002).all()
