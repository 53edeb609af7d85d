"""Working view of the scene network: plan coordinates, rotation to upright, filled holes."""

import numpy as np
import pytest

from perception.detection.geometry import points_of
from perception.detection.working_view import downscale, fill_from_nearest, quarter_turns, working_view
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

PLANE = SupportPlane()
TARGET = (0.48, -0.22, 0.05)


@pytest.fixture
def frame(scenes):
    solids = [scenes.Solid(0.45, -0.25, 0.1, radius=0.04)]
    return scenes.render(solids, scenes.orbit(TARGET, 0.5, 45, 200), size=(640, 480)).frame


def rolled(frame, quarters):
    """Return the image of the camera rotated clockwise about its optical axis by quarter turns."""
    k, T = frame.intrinsics, frame.T_world_camera.copy()
    for _ in range(quarters):  # a clockwise rotation of the camera rotates the image counterclockwise
        T[:3, :3] = np.stack([T[:3, 1], -T[:3, 0], T[:3, 2]], axis=1)
        k = CameraIntrinsics(k.height, k.width, k.fy, k.fx, k.cy, k.width - 1 - k.cx)
    return RgbdFrame(0.0, np.rot90(frame.rgb, quarters), np.rot90(frame.depth, quarters), k, T)


def test_downscaling_keeps_the_rays_and_does_not_interpolate_depths(frame):
    small = downscale(frame)
    assert small.depth.shape == (240, 320) and downscale(small).depth.shape == (240, 320)
    assert set(np.unique(small.depth)) <= set(np.unique(frame.depth))
    k, K = small.intrinsics, frame.intrinsics
    corner = (-0.5 - k.cx) / k.fx, (k.width - 0.5 - k.cx) / k.fx
    assert corner == pytest.approx(((-0.5 - K.cx) / K.fx, (K.width - 0.5 - K.cx) / K.fx))


def test_plan_coordinates_are_those_of_the_points(frame):
    view = working_view(downscale(frame), PLANE)
    assert view.turns == 0
    points = points_of(downscale(frame), np.ones(view.height.shape, bool)).reshape(*view.height.shape, 3)
    np.testing.assert_allclose(view.plan, points @ view.axes.T, atol=1e-4)
    np.testing.assert_allclose(view.height, points[..., 2], atol=1e-4)
    np.testing.assert_allclose(view.axes @ view.axes.T, np.eye(2), atol=1e-9)
    np.testing.assert_allclose(view.axes @ PLANE.normal, 0, atol=1e-9)
    assert view.plan[120, 200, 0] > view.plan[120, 100, 0]  # right in the image is along the first axis
    assert view.plan[60, 160, 1] > view.plan[200, 160, 1]  # up in the image is away


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_rolled_camera_has_the_same_working_view(frame, quarters):
    upright, turned = downscale(frame), rolled(downscale(frame), quarters)
    assert quarter_turns(turned, PLANE) == (4 - quarters) % 4
    a, b = working_view(upright, PLANE), working_view(turned, PLANE)
    np.testing.assert_allclose(a.axes, b.axes, atol=1e-9)
    np.testing.assert_allclose(a.channels, b.channels, atol=2e-3)
    np.testing.assert_allclose(a.plan, b.plan, atol=1e-4)


def test_views_from_straight_above_are_not_rotated(scenes):
    frame = scenes.render([], scenes.orbit(TARGET, 0.5, 89, 10)).frame
    assert quarter_turns(frame, PLANE) == quarter_turns(rolled(frame, 1), PLANE) == 0


def test_holes_are_filled_with_the_nearest_depth_and_marked(frame):
    depth = frame.depth.copy()
    depth[200:210, 300:310] = 0
    holed = downscale(RgbdFrame(0.0, frame.rgb, depth, frame.intrinsics, frame.T_world_camera))
    view = working_view(holed, PLANE)
    assert not view.measured[102, 152] and view.channels[102, 152, 5] == 0
    assert np.isfinite(view.plan).all() and (view.pixel > 0).all()
    blind = RgbdFrame(0.0, frame.rgb, 0 * depth, frame.intrinsics, frame.T_world_camera)
    assert np.isfinite(working_view(blind, PLANE).channels).all()


def test_missing_values_are_those_of_the_nearest_neighbour():
    values = np.array([[1, 0, 0, 0, 2]], np.int32)
    spread, distance = fill_from_nearest(values, values > 0)
    assert spread[0, [0, 1, 3, 4]].tolist() == [1, 1, 2, 2]
    assert distance[0, 0] == 0 and distance[0, 1] == pytest.approx(1, abs=0.1)
