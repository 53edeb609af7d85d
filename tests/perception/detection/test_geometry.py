"""Heights, plan coordinates, projections and headings on a rendered post and in closed form."""

import numpy as np
import pytest

from perception.detection.geometry import (
    bounding_window,
    camera_pose,
    heading_angle,
    height_image,
    in_image,
    linear_in_depth,
    plan_coordinates,
    plane_axes,
    points_of,
    project,
    touches_border,
    view_heading,
)
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

PLANE = SupportPlane()
TALL = (0.45, -0.2, 0.2)


def rolled(T, degrees):
    """Return the camera pose rolled about the optical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.eye(4)
    R[:2, :2] = [[c, -s], [s, c]]
    return T @ R


@pytest.fixture
def post(scenes):
    """A post 20 cm high, seen at an elevation of 45 degrees by a camera with any roll."""

    def view(roll):
        T = rolled(scenes.orbit((0.45, -0.2, 0.08), 0.5, 45, 130), roll)
        return scenes.render([scenes.Solid(*TALL, radius=0.02)], T, size=(640, 480))

    return view


def test_heading_runs_up_in_the_image_and_away_from_the_camera(post):
    scene = post(0)
    frame = scene.frame
    point = np.array([0.45, -0.2, 0.1])
    heading = view_heading(frame, PLANE, point)
    eye = frame.T_world_camera[:3, 3]
    assert heading @ PLANE.normal == pytest.approx(0, abs=1e-12)
    assert heading @ (point - eye) > 0
    pixels, _ = project(frame, np.stack([point, point + 0.05 * heading, point + 0.05 * PLANE.normal]))
    along, up = pixels[1] - pixels[0], pixels[2] - pixels[0]
    cosine = along @ up / np.linalg.norm(along) / np.linalg.norm(up)
    assert cosine > 0.999


def test_from_straight_above_the_image_top_is_the_heading(scenes):
    frame = scenes.render([], scenes.orbit((0.45, -0.2, 0.0), 0.5, 90, 0)).frame
    heading = view_heading(frame, PLANE, np.array([0.45, -0.2, 0.1]))
    assert heading == pytest.approx(-frame.T_world_camera[:3, 1], abs=1e-6)


def test_heights_and_points_agree_with_the_scene(post):
    scene = post(37)
    points = points_of(scene.frame, scene.instances == 0)
    assert np.hypot(*(points[:, :2] - TALL[:2]).T).max() < 0.0201
    heights = height_image(scene.frame, PLANE)[scene.instances == 0]
    assert heights == pytest.approx(points[:, 2], abs=1e-5)
    assert np.abs(height_image(scene.frame, PLANE)[scene.instances < 0]).max() < 1e-5


@pytest.mark.parametrize("normal", [(0, 0, 1), (1, 0, 0), (0, -0.6, -0.8)])
def test_plane_axes_are_right_handed(normal):
    plane = SupportPlane(normal=np.array(normal, dtype=float))
    first, second = plane_axes(plane)
    assert np.cross(first, second) == pytest.approx(plane.normal)


K = CameraIntrinsics(4, 3, 2.0, 4.0, 1.0, 0.5)
TILTED = SupportPlane(normal=np.array([0.0, -0.6, -0.8]), offset=-1.0)


def flat_frame(depth=1.0, T=None):
    return RgbdFrame(0.0, np.zeros((3, 4, 3), np.uint8), np.full((3, 4), depth, np.float32), K, T)


def test_a_frame_without_pose_is_in_its_own_world():
    np.testing.assert_array_equal(camera_pose(flat_frame()), np.eye(4))


def test_points_are_back_projected_by_the_pinhole_model():
    mask = np.zeros((3, 4), bool)
    mask[2, 3] = True
    T = np.eye(4)
    T[:3, 3] = (10, 20, 30)
    np.testing.assert_allclose(points_of(flat_frame(2.0), mask), [[2.0, 0.75, 2.0]])
    np.testing.assert_allclose(points_of(flat_frame(2.0, T), mask), [[12.0, 20.75, 32.0]])
    own = np.full((3, 4), 4.0, np.float32)
    np.testing.assert_allclose(points_of(flat_frame(2.0), mask, own), [[4.0, 1.5, 4.0]])
    assert points_of(flat_frame(0.0), mask).shape == (0, 3)


def test_projection_inverts_back_projection():
    frame = flat_frame(1.5, np.diag([1.0, -1.0, -1.0, 1.0]))
    pixels, z = project(frame, points_of(frame, np.ones((3, 4), bool)))
    v, u = np.mgrid[:3, :4]
    np.testing.assert_array_equal(pixels, np.stack([u.ravel(), v.ravel()], 1))
    np.testing.assert_allclose(z, 1.5)
    assert project(frame, np.array([[0.0, 0.0, 1.0]]))[1][0] == -1.0  # behind the camera


def test_what_is_in_the_image_is_within_its_borders_and_in_front_of_the_camera():
    frame = flat_frame(1.5)
    pixels = np.array([[0, 0], [3, 2], [-1, 0], [0, -1], [4, 2], [3, 3], [1, 1]])
    depth = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0])
    np.testing.assert_array_equal(in_image(frame, pixels, depth), [True, True, *[False] * 5])


def test_heights_are_linear_in_depth():
    frame = flat_frame(1.5)
    slope, constant = linear_in_depth(frame, TILTED.normal)
    points = points_of(frame, np.ones((3, 4), bool))
    np.testing.assert_allclose((slope * 1.5 + constant).ravel(), points @ TILTED.normal, atol=1e-6)
    np.testing.assert_allclose(height_image(frame, TILTED).ravel(), TILTED.height_above(points), atol=1e-6)
    doubled = height_image(frame, TILTED, np.full((3, 4), 3.0, np.float32)).ravel()
    np.testing.assert_allclose(doubled, TILTED.height_above(2 * points), atol=1e-6)


def test_plan_coordinates_on_a_level_plane_are_world_x_and_y():
    points = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(plan_coordinates(points, PLANE), [[1.0, 2.0]])
    assert heading_angle(np.array([0.0, 1.0, 0.0]), PLANE) == pytest.approx(np.pi / 2)


def test_the_bounding_window_is_clipped_at_the_image():
    mask = np.zeros((10, 20), bool)
    mask[2:5, 3:7] = True
    assert bounding_window(mask) == (slice(2, 5), slice(3, 7))
    rows, columns = bounding_window(mask, 3)
    assert (rows, columns) == (slice(0, 8), slice(0, 10))


@pytest.mark.parametrize(
    ("v", "u", "touches"), [(0, 5, 1), (9, 5, 1), (5, 0, 1), (5, 19, 1), (1, 1, 0), (8, 18, 0)]
)
def test_a_mask_touches_the_border_at_any_of_its_four_sides(v, u, touches):
    mask = np.zeros((10, 20), bool)
    mask[v, u] = True
    assert touches_border(mask) == bool(touches)
