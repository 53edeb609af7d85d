"""Active stereo: error against distance, shadows, range, losses on dark surfaces."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors import active_stereo as stereo
from sim_assets.rendering.depth_sensors.active_stereo import active_stereo

INTRINSICS = CameraIntrinsics(480, 160, 600.0, 600.0, 239.5, 79.5)
BASELINE = 0.05


@pytest.fixture(autouse=True)
def one_camera(monkeypatch):
    monkeypatch.setattr(stereo, "BASELINES", (BASELINE,))
    monkeypatch.setattr(stereo, "MARGIN", (0.3, 0.3))


def wall(distance):
    return np.full((160, 480), distance, dtype=np.float32)


@pytest.mark.parametrize("distance", [0.5, 0.9, 1.5])
def test_error_is_that_of_a_disparity_error_of_less_than_a_tenth_of_a_pixel(rng, distance):
    noisy = active_stereo(wall(distance), INTRINSICS, rng)
    measured = noisy[noisy > 0]
    assert len(measured) > 0.97 * noisy.size
    s = np.std(measured) / distance**2 * INTRINSICS.fx * BASELINE
    assert 0.02 < s < 0.12
    assert np.median(measured) == pytest.approx(distance, rel=0.005)


def test_depth_comes_in_steps_of_disparity(rng):
    noisy = active_stereo(wall(0.8), INTRINSICS, rng)
    steps = INTRINSICS.fx * BASELINE / noisy[noisy > 0] / stereo.STEP
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)


@pytest.mark.parametrize("far", [0.8, 1.0])
def test_the_shadow_is_left_of_a_near_surface_and_as_wide_as_the_parallax(rng, far):
    depth = wall(far)
    depth[:, 250:400] = 0.5
    noisy = active_stereo(depth, INTRINSICS, rng)
    width = INTRINSICS.fx * BASELINE * (1 / 0.5 - 1 / far)
    lost = (noisy[20:140] == 0)[:, 200:260].sum(axis=1)
    assert np.median(lost) == pytest.approx(width, abs=5)  # less or more half a block
    assert (noisy[20:140, 405:440] == 0).mean() < 0.1


def test_what_is_out_of_range_is_not_measured(rng):
    for outside in (0.1, 0.169, 8.1):
        assert not active_stereo(wall(outside), INTRINSICS, rng).any()


def test_a_camera_without_margin_does_not_see_the_left_border(rng, monkeypatch):
    monkeypatch.setattr(stereo, "MARGIN", (0.0, 0.0))
    noisy = active_stereo(wall(0.6), INTRINSICS, rng)
    disparity = INTRINSICS.fx * BASELINE / 0.6
    assert not noisy[:, : int(disparity) - 1].any()
    assert (noisy[:, int(disparity) + 4 :] > 0).mean() > 0.97


def test_dark_surfaces_far_away_are_lost_and_noisier(rng):
    rgb = np.full((160, 480, 3), 150, dtype=np.uint8)
    rgb[:, 240:] = 0
    noisy = active_stereo(wall(3.0), INTRINSICS, rng, rgb)
    lost = noisy == 0
    assert lost[:, 260:].mean() > lost[:, :220].mean() + 0.3
    near = active_stereo(wall(0.6), INTRINSICS, rng, rgb)
    assert near[:, 260:].std() > 1.5 * near[:, :220].std() > 0


def test_half_the_resolution_measures_as_well(rng):
    camera = CameraIntrinsics(240, 80, 300.0, 300.0, 119.5, 39.5)
    noisy = active_stereo(np.full((80, 240), 0.8, dtype=np.float32), camera, rng)
    measured = noisy[8:-8, 8:-8]
    assert (measured > 0).mean() > 0.98
    assert np.std(measured[measured > 0]) < 0.12 * 0.8**2 / (600 * BASELINE)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
