"""What an image with calibration errors shows: its plane, where points appear, and what is cut off."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.datasets.perceived import (
    TABLE,
    cut_depth,
    depth_scale,
    perceived_plane,
    perceived_points,
    table_pixels,
    world_points,
)

CAMERA = CameraIntrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)
OVERHEAD = np.diag([1.0, -1.0, -1.0, 1.0])
OVERHEAD[2, 3] = 0.8


def view(depth, camera=CAMERA):
    return RgbdFrame(0.0, np.zeros((60, 80, 3), np.uint8), depth.astype(np.float32), camera, OVERHEAD)


@pytest.fixture
def table():
    """A bare table 0.8 m below the camera, with a box 5 cm high in the middle."""
    depth = np.full((60, 80), 0.8)
    depth[20:40, 30:50] = 0.75
    return view(depth)


def test_table_pixels_are_those_at_height_zero_without_items(table):
    item = np.zeros((60, 80), bool)
    item[50:, :] = True
    pixels = table_pixels(table, item)
    assert pixels.sum() == 60 * 80 - 20 * 20 - 10 * 80 and not pixels[30, 40]
    assert not table_pixels(view(np.zeros((60, 80))), item).any()


def test_world_points_of_a_tilted_camera():
    """A camera 1 m high that looks down at 30 degrees sees the table 2 m away along its axis."""
    T = np.eye(4)
    c, s = np.cos(np.radians(30)), np.sin(np.radians(30))
    T[:3, :3] = np.array([[0, -s, c], [-1, 0, 0], [0, -c, -s]])
    T[2, 3] = 1.0
    camera = CameraIntrinsics(3, 3, 70.0, 70.0, 1.0, 1.0)
    frame = RgbdFrame(0.0, np.zeros((3, 3, 3), np.uint8), np.full((3, 3), 2.0, np.float32), camera, T)
    np.testing.assert_allclose(world_points(frame)[1, 1], [2 * c, 0, 0], atol=1e-6)


def test_a_wrong_depth_scale_sinks_the_plane_and_moves_points_along_their_rays(table):
    pixels = table_pixels(table, np.zeros((60, 80), bool))
    deeper = view(table.depth * 1.01)
    plane = perceived_plane(deeper, pixels, np.random.default_rng(0))
    np.testing.assert_allclose([*plane.normal, plane.offset], [0, 0, 1, -0.008], atol=1e-5)
    assert depth_scale(deeper, table, pixels) == pytest.approx(1.01)
    np.testing.assert_allclose(
        perceived_points(np.array([[0.1, 0.2, 0.0]]), CAMERA, deeper, 1.01), [[0.101, 0.202, -0.008]]
    )


def test_points_follow_wrong_intrinsics(table):
    """A focal length 2 % too long shrinks what is back-projected by 2 %; a shifted centre shifts it."""
    wrong = view(table.depth, CameraIntrinsics(80, 60, 71.4, 71.4, 41.5, 29.5))
    seen = perceived_points(np.array([[0.1, 0.0, 0.0]]), CAMERA, wrong, 1.0)[0]
    np.testing.assert_allclose(seen, [0.1 / 1.02 - 0.8 * 2 / 71.4, 0, 0], atol=1e-9)


def test_outliers_do_not_tilt_the_plane_and_few_pixels_give_the_true_one(table):
    pixels = table_pixels(table, np.zeros((60, 80), bool))
    noisy = table.depth.copy()
    noisy[:6, :] -= 0.3
    plane = perceived_plane(view(noisy), pixels, np.random.default_rng(0))
    np.testing.assert_allclose([*plane.normal, plane.offset], [0, 0, 1, 0], atol=1e-4)
    few = np.zeros((60, 80), bool)
    few[0, :10] = True
    assert perceived_plane(view(noisy), few, np.random.default_rng(0)) is TABLE
    assert depth_scale(view(noisy), table, few) == 1.0


def test_depth_is_cut_beyond_a_limit_or_at_the_borders():
    depth = np.tile(np.linspace(0.3, 4.0, 80, dtype=np.float32), (60, 1))
    beyond = at_border = 0
    for seed in range(40):
        cut = cut_depth(depth, np.random.default_rng(seed))
        kept = cut > 0
        np.testing.assert_array_equal(cut[kept], depth[kept])
        rows, columns = np.flatnonzero(kept.any(1)), np.flatnonzero(kept.any(0))
        assert kept[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all()
        beyond += depth[kept].max() <= 2.5
        at_border += rows[0] > 0 or columns[0] > 0
        assert rows[0] <= 5 and columns[0] <= 6
    assert beyond > 15 and at_border > 15
