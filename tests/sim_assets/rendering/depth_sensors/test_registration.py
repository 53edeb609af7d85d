"""Errors of registration and calibration."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.registration import _shifted, misregister

INTRINSICS = CameraIntrinsics(160, 120, 600.0, 600.0, 79.5, 59.5)


def scene():
    depth = np.full((120, 160), 1.0, dtype=np.float32)
    depth[40:80, 60:100] = 0.5
    return depth


def test_errors_stay_within_their_limits_and_colour_as_it_is():
    rgb = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    depth = scene()
    for seed in range(20):
        colour, moved, camera = misregister(rgb, depth, INTRINSICS, np.random.default_rng(seed))
        assert np.array_equal(colour, rgb) and moved.dtype == np.float32 and moved.shape == depth.shape
        assert camera.fx == camera.fy == pytest.approx(600, rel=0.01)
        assert abs(camera.cx - 79.5) <= 6 and abs(camera.cy - 59.5) <= 6
        near = (moved > 0) & (moved < 0.7)
        rows, columns = np.nonzero(near)
        assert abs(columns.mean() - 79.5) <= 3.5 and abs(rows.mean() - 59.5) <= 3.5
        assert np.median(moved[near]) == pytest.approx(0.5, rel=0.0101)


@pytest.mark.parametrize("parallax", [1.5, -1.5])
def test_parallax_leaves_a_hole_on_one_side_and_covers_on_the_other(parallax):
    depth = scene()
    moved = _shifted(depth, np.zeros(2), parallax, 3.0)
    # 1.5 / 0.5 = 3 px for the box, 1.5 / 1.0 rounded to 2 px for the wall.
    row = moved[60]
    shift = 3 if parallax > 0 else -3
    assert np.all(row[60 + shift : 100 + shift] == 0.5)
    hole = 60 + shift - 1 if parallax > 0 else 100 + shift
    assert row[hole] == 0 and (row[10:150] == 0).sum() == 1


def test_same_seed_same_errors():
    rgb = np.zeros((120, 160, 3), np.uint8)
    first, second = (misregister(rgb, scene(), INTRINSICS, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first[1], second[1]) and first[2] == second[2]
