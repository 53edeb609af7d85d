"""Crops are gravity-upright and their directions mean what they say; yaw survives the trip to the world."""

import numpy as np
import pytest

from perception.detection.crops import SIDE, crop, mask_core, stack_crops
from perception.detection.geometry import (
    heading_angle,
    height_image,
    plane_axes,
    points_of,
    project,
    view_heading,
)
from perception.detection.yaw import YAW_BINS, bin_centres, entropy, fuse_yaws, modes, rotate_yaw, soft_labels
from perception.errors import InvalidInputError
from perception.types import RgbdFrame, SupportPlane

PLANE = SupportPlane()
TALL = (0.45, -0.2, 0.2)


def rolled(T, degrees):
    """The camera turned about its optical axis."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.eye(4)
    R[:2, :2] = [[c, -s], [s, c]]
    return T @ R


@pytest.fixture
def post(scenes):
    """A post 20 cm high, seen from 45 degrees by a camera rolled by any angle."""

    def view(roll):
        T = rolled(scenes.orbit((0.45, -0.2, 0.08), 0.5, 45, 130), roll)
        return scenes.render([scenes.Solid(*TALL, radius=0.02)], T, size=(640, 480))

    return view


@pytest.mark.parametrize("roll", [0, 37, 90, 180, 251])
def test_gravity_points_down_however_the_camera_is_rolled(post, roll):
    scene = post(roll)
    piece = crop(scene.frame, scene.instances == 0, PLANE)
    v, u = np.nonzero(piece.image[..., 3] > 128)
    assert np.ptp(v) > 2.5 * np.ptp(u)  # upright
    assert abs(u.mean() - (SIDE - 1) / 2) < 1 and abs(v.mean() - (SIDE - 1) / 2) < 3  # centred
    height = piece.image[..., 4].astype(float)
    rows = [height[i][piece.image[i, :, 3] > 250].mean() for i in (14, 32, 50)]
    assert rows[0] > rows[1] > rows[2]  # the top is up


def test_pixels_hold_metres(post):
    scene = post(0)
    piece = crop(scene.frame, scene.instances == 0, PLANE)
    height = piece.image[..., 4][piece.image[..., 3] == 255]
    assert height.max() * 0.30 / 255 == pytest.approx(0.2, abs=0.004)
    side = 0.15 * np.exp(piece.context[0])
    assert side == pytest.approx(1.35 * 0.2 * np.cos(np.radians(45)), rel=0.3)
    assert piece.context[1] == pytest.approx(np.sin(np.radians(45)), abs=0.1)


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


def test_a_mask_that_lost_a_part_changes_the_mask_alone(scenes):
    """The lower part of a post is masked; the upper one is still to be seen, table and border too."""
    T = scenes.orbit((0.45, -0.2, 0.14), 0.3, 20, 130)
    scene = scenes.render([scenes.Solid(*TALL, radius=0.02)], T, size=(640, 480))
    lower = (scene.instances == 0) & (height_image(scene.frame, PLANE) < 0.15)
    piece = crop(scene.frame, lower, PLANE).image.astype(float)
    masked = piece[..., 3] > 128
    metres = piece[..., 4] * 0.30 / 255
    assert metres[masked].max() < 0.155 < metres[~masked].max()
    table = (piece[..., 5] > 0) & (metres < 0.005) & ~masked
    assert table.sum() > 200 and (piece[..., 5][table] > 127).any()  # farther than the post


def test_beyond_the_border_and_where_depth_is_missing(post):
    scene = post(0)
    depth = scene.frame.depth.copy()
    depth[:, : depth.shape[1] // 2 - 40] = 0
    frame = RgbdFrame(0.0, scene.frame.rgb, depth, scene.frame.intrinsics, scene.frame.T_world_camera)
    everything = crop(frame, np.ones_like(depth, dtype=bool), PLANE).image
    outside = everything[..., 3] == 0
    assert outside.any() and not everything[outside].any()
    missing = (everything[..., 4] == 0) & (everything[..., 5] == 127)
    assert 0.3 < missing[everything[..., 3] == 255].mean() < 0.6


def test_a_mask_without_depth_is_an_error(post):
    frame = post(0).frame
    blind = RgbdFrame(0.0, frame.rgb, 0 * frame.depth, frame.intrinsics, frame.T_world_camera)
    with pytest.raises(InvalidInputError, match="contains no measured depth"):
        crop(blind, np.ones_like(frame.depth, dtype=bool), PLANE)


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


# --- yaw ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi, -2.0])
@pytest.mark.parametrize("azimuth", [0, 70, 200, 315])
def test_yaw_relative_to_the_view_becomes_world_yaw(scenes, yaw, azimuth):
    """Geometric round trip: an arrow at the object's yaw, its angle measured against the heading alone."""
    frame = scenes.render([], scenes.orbit((0.45, -0.2, 0.05), 0.5, 55, azimuth)).frame
    point = np.array([0.45, -0.2, 0.05])
    heading = view_heading(frame, PLANE, point)
    arrow = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    relative = np.arctan2(np.cross(heading, arrow) @ PLANE.normal, heading @ arrow)
    world = rotate_yaw(soft_labels(np.array([relative]))[0], heading_angle(heading, PLANE))
    (found, _), *_ = modes(world)
    assert abs((found - yaw + np.pi) % (2 * np.pi) - np.pi) < np.radians(1.0)


def test_soft_labels_are_centred_distributions():
    labels = soft_labels(np.array([0.0, 3.0, -0.3]))
    assert labels.sum(1) == pytest.approx(1.0)
    mean = np.angle(labels @ np.exp(1j * bin_centres()))
    assert mean == pytest.approx([0.0, 3.0, -0.3], abs=1e-3)


def test_turning_by_whole_bins_rolls():
    p = soft_labels(np.array([1.0]))[0]
    assert rotate_yaw(p, 5 * 2 * np.pi / YAW_BINS) == pytest.approx(np.roll(p, 5))
    assert rotate_yaw(p, 0.123).sum() == pytest.approx(1.0)


def test_fusion_sharpens_agreement_and_survives_one_confident_mistake():
    right = soft_labels(np.array([1.0]), spread=0.3)[0]
    wrong = soft_labels(np.array([-2.0]), spread=0.05)[0]
    assert entropy(fuse_yaws([right, right])) < entropy(right)
    (yaw, _), *_ = modes(fuse_yaws([right, right, right, wrong]))
    assert yaw == pytest.approx(1.0, abs=0.05)


def test_modes_list_both_of_two_candidates():
    both = 0.7 * soft_labels(np.array([0.5]))[0] + 0.3 * soft_labels(np.array([3.6]))[0]
    (first, heavy), (second, light) = modes(both)
    assert (first, second) == pytest.approx((0.5, 3.6), abs=0.03)
    assert heavy > light
    assert len(modes(np.full(YAW_BINS, 1 / YAW_BINS))) == 1


def test_the_core_of_a_mask_has_no_thin_arms_and_no_specks():
    mask = np.zeros((120, 160), bool)
    mask[60:, 20:80] = True  # cut by the image's border
    body = mask.copy()
    mask[64:67, 80:140] = True
    mask[10:14, 100:104] = True
    kept = mask_core(mask)
    assert (kept & ~body).sum() < 10
    assert (body & ~kept).sum() < 30  # the opening rounds the corners, but not at the border
    assert kept[-1, 20:80].all()


def test_what_is_thin_all_over_is_its_own_core():
    mask = np.zeros((120, 160), bool)
    mask[50:54, 10:150] = True
    assert mask_core(mask) is mask


def test_no_crops_stack_to_empty_arrays():
    images, context = stack_crops([])
    assert images.shape == (0, SIDE, SIDE, 6) and context.shape == (0, 2)
