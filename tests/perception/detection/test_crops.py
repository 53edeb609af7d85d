"""Crops: gravity alignment, metric channels, context, missing depth, cores of masks."""

import numpy as np
import pytest

from perception.detection.crops import SIDE, crop, mask_core, stack_crops
from perception.detection.geometry import (
    height_image,
)
from perception.errors import InvalidInputError
from perception.types import RgbdFrame, SupportPlane

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


def test_an_incomplete_mask_changes_the_mask_channel_only(scenes):
    """The lower part of a post is masked; the other channels still show the upper part and the table."""
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


def test_the_core_of_a_mask_has_neither_thin_parts_nor_specks():
    mask = np.zeros((120, 160), bool)
    mask[60:, 20:80] = True  # cut by the image's border
    body = mask.copy()
    mask[64:67, 80:140] = True
    mask[10:14, 100:104] = True
    kept = mask_core(mask)
    assert (kept & ~body).sum() < 10
    assert (body & ~kept).sum() < 30  # the opening rounds the corners, but not at the border
    assert kept[-1, 20:80].all()


def test_a_thin_mask_is_its_own_core():
    mask = np.zeros((120, 160), bool)
    mask[50:54, 10:150] = True
    assert mask_core(mask) is mask


def test_no_crops_stack_to_empty_arrays():
    images, context = stack_crops([])
    assert images.shape == (0, SIDE, SIDE, 6) and context.shape == (0, 2)
