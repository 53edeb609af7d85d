"""Solid space of a box rendered in closed form: measured, carved and hidden voxels."""

import numpy as np
import pytest

from perception.detection.geometry import height_image, points_of
from perception.obstacles.volume import VolumeConfig, lowest_height, solid_of
from perception.types import SupportPlane

LOW, HIGH = np.array((-0.03, -0.02, 0.0)), np.array((0.03, 0.02, 0.06))


@pytest.fixture(scope="module")
def views(scenes):
    box = scenes.Solid(0.0, 0.0, 0.06, half=(0.03, 0.02))
    angles = [(50, 20), (50, 200), (88, 0)]
    return [scenes.render([box], scenes.orbit((0, 0, 0.03), 0.5, *angle)).frame for angle in angles]


def measured(frames):
    clouds = []
    for frame in frames:
        height = height_image(frame, SupportPlane())
        clouds.append(points_of(frame, height > lowest_height(frame.depth)))
    return np.concatenate(clouds)


def beyond(points):
    """Distance [m] outside the box, by the axis with the largest."""
    return np.maximum(LOW - points, points - HIGH).max(axis=1)


def test_the_solid_is_the_box_and_the_free_space_is_not(views):
    solid = solid_of(measured(views), views, np.eye(4))
    assert beyond(solid.points).max() < 0.006
    assert beyond(solid.free).min() > -0.001
    np.testing.assert_allclose(solid.points.min(axis=0), LOW, atol=0.005)
    np.testing.assert_allclose(solid.points.max(axis=0), HIGH, atol=0.005)


def test_another_view_carves_what_one_view_leaves_hidden(views):
    alone = solid_of(measured(views[:1]), views[:1], np.eye(4))
    both = solid_of(measured(views[:1]), views[:2], np.eye(4))
    assert beyond(alone.points).max() > 0.015 > 0.006 > beyond(both.points).max()


def test_hidden_space_ends_at_its_limit(views):
    points = measured(views[:1])
    near = solid_of(points, views[:1], np.eye(4), VolumeConfig(max_hidden=0.01))
    far = solid_of(points, views[:1], np.eye(4), VolumeConfig(max_hidden=0.04))
    assert beyond(near.points).max() < 0.016 < beyond(far.points).max() < 0.046


def test_stray_points_that_a_view_sees_through_are_free(views):
    stray = np.tile((0.0, 0.0, 0.10), (5, 1))
    solid = solid_of(np.concatenate([measured(views), stray]), views, np.eye(4))
    assert solid.points[:, 2].max() < 0.066


def test_voxels_with_few_points_are_not_measured(views):
    assert len(solid_of(np.array([(0.0, 0.0, 0.058)] * 2), views, np.eye(4)).points) == 0


def test_the_support_may_be_in_any_pose(views):
    """The same scene in a world whose support stands upright."""
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    T[:3, 3] = 0.1, 0.2, 0.3
    moved = [type(f)(f.time, f.rgb, f.depth, f.intrinsics, T @ f.T_world_camera) for f in views]
    solid, plain = (solid_of(measured(views), v, pose) for v, pose in ((moved, T), (views, np.eye(4))))
    assert len(solid.points) == pytest.approx(len(plain.points), rel=0.01)
    assert beyond(solid.points).max() < 0.006
