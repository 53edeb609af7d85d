"""Structured light: steps, shadows on both sides, noise, range and losses."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors import structured_light as kinect
from sim_assets.rendering.depth_sensors.structured_light import structured_light

INTRINSICS = CameraIntrinsics(480, 160, 580.0, 580.0, 239.5, 79.5)
FOCAL_BASELINE = 580.0 * 0.075


@pytest.fixture(autouse=True)
def no_border(monkeypatch):
    monkeypatch.setattr(kinect, "BORDER", 0.0)


@pytest.fixture
def undistorted(monkeypatch):
    monkeypatch.setattr(kinect, "DISTORTION", 0.0)


def wall(distance):
    return np.full((160, 480), distance, dtype=np.float32)


def test_depth_comes_in_eighths_of_a_pixel(rng):
    noisy = structured_light(wall(1.0), INTRINSICS, rng)
    values = np.unique(noisy[noisy > 0])
    steps = FOCAL_BASELINE / values * 8
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    near = np.sort(np.abs(np.diff(values)))
    assert np.median(near) == pytest.approx(1 / (8 * FOCAL_BASELINE), rel=0.1)  # 2.9 mm at 1 m


@pytest.mark.parametrize("distance", [0.6, 1.2, 2.0])
def test_axial_noise_grows_with_the_square_of_distance(rng, undistorted, distance):
    noisy = structured_light(wall(distance), INTRINSICS, rng)
    steps = np.hypot(kinect.AXIAL, 1 / 8 / np.sqrt(12))  # [px]: error of the matching and of the rounding
    assert np.std(noisy[noisy > 0]) == pytest.approx(distance**2 * steps / FOCAL_BASELINE, rel=0.15)


@pytest.mark.parametrize("far", [0.8, 1.1])
def test_shadows_on_both_sides_add_up_to_the_parallax_of_the_baseline(rng, far):
    depth = wall(far)
    depth[:, 200:300] = 0.6
    lost = structured_light(depth, INTRINSICS, rng)[10:150] == 0
    parallax = FOCAL_BASELINE * (1 / 0.6 - 1 / far)
    left, right = (np.median(side.sum(axis=1)) for side in (lost[:, 150:205], lost[:, 295:340]))
    # Widened outlines take about one pixel on either side.
    assert left == pytest.approx(parallax * 2 / 3, abs=2.5)
    assert right == pytest.approx(parallax / 3, abs=2.5)


def test_an_outline_is_ragged(rng):
    depth = wall(0.9)
    depth[80:] = 0.6
    noisy = structured_light(depth, INTRINSICS, rng)
    near = ((noisy > 0.5) & (noisy < 0.7)).sum(axis=0)[20:460]
    assert 0.5 < near.std() < 2.5 and abs(near.mean() - 80) < 2


def test_what_is_out_of_range_is_not_measured(rng):
    for outside in (0.3, 4.4):
        assert not structured_light(wall(outside), INTRINSICS, rng).any()
    assert (structured_light(wall(0.5), INTRINSICS, rng)[8:-8, 8:-8] > 0).all()


def test_dark_patches_and_highlights_are_lost(rng):
    rgb = np.full((160, 480, 3), 140, dtype=np.uint8)
    rgb[:, 300:] = 0
    rgb[60:70, 100:110] = 255
    lost = structured_light(wall(1.8), INTRINSICS, rng, rgb)[10:-10] == 0
    assert lost[:, 320:470].mean() > 0.5
    assert lost[:, 120:290].mean() < 0.02 and lost[52:58, 102:108].mean() > 0.5


def test_grazing_incidence_is_lost(rng):
    y = (np.arange(160) - INTRINSICS.cy)[:, None] / INTRINSICS.fy

    def loss(degrees):
        tangent = np.tan(np.radians(degrees))
        depth = np.broadcast_to(0.8 / (1 - tangent * y), (160, 480)).astype(np.float32)
        depth = np.where(depth > 0, depth, 9.0).astype(np.float32)
        return (structured_light(depth, INTRINSICS, rng)[70:90, 20:-20] == 0).mean()

    assert loss(60) < 0.02 < 0.1 < loss(82) < loss(86)


def test_the_border_is_empty(rng, monkeypatch):
    monkeypatch.setattr(kinect, "BORDER", 0.1)
    empty = [
        np.argmax(np.any(structured_light(wall(0.8), INTRINSICS, rng)[:, ::-1] > 0, axis=0)) for _ in range(8)
    ]
    assert max(empty) > 10 and max(empty) <= 50


@pytest.fixture
def rng():
    return np.random.default_rng(0)
