"""Portraits: the whole object is in every view, and where the truth says it is."""

import numpy as np
import pytest

from sim_assets.datasets.single_object import SingleObjectConfig, render_single_object
from sim_assets.objects import sample_object

EXACT = SingleObjectConfig(width=160, height=120, depth_noise="none")


@pytest.fixture(scope="module")
def bottle():
    return sample_object("bottle", "test", np.random.default_rng(3))


@pytest.fixture(scope="module")
def portrait(bottle):
    return render_single_object(bottle, 3, np.random.default_rng(5), EXACT)


def points_above_table(frame):
    v, u = np.nonzero(frame.depth > 0)
    z, k, T = frame.depth[v, u].astype(np.float64), frame.intrinsics, frame.T_world_camera
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1) @ T[:3, :3].T + T[:3, 3]
    high = (points[:, 2] > 0.005) & (np.abs(points[:, :2]).max(axis=1) < 0.5)
    return points[high], u[high], v[high]


def test_object_is_whole_in_every_view_and_where_the_truth_says(bottle, portrait):
    for frame in portrait.frames:
        points, u, v = points_above_table(frame)
        assert len(points) > 100
        assert min(u.min(), v.min()) > 0 and u.max() < 159 and v.max() < 119
        local = (points - portrait.T_world_object[:3, 3]) @ portrait.T_world_object[:3, :3]
        low, high = bottle.mesh.bounds
        assert (local > low - 0.002).all() and (local < high + 0.002).all()
        assert local[:, 2].max() > 0.9 * bottle.height


def test_same_seed_same_portrait(bottle, portrait):
    again = render_single_object(bottle, 3, np.random.default_rng(5), EXACT)
    np.testing.assert_array_equal(again.frames[1].depth, portrait.frames[1].depth)
    np.testing.assert_array_equal(again.frames[1].rgb, portrait.frames[1].rgb)
    assert not np.array_equal(portrait.frames[0].depth, portrait.frames[1].depth)
