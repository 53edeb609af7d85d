"""Depth noise: its size, its holes, its steps."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_noise import add_depth_noise, beside_edges, incidence

# The stereo camera that is modelled: baseline [m], deviation and step of the disparity [px].
BASELINE, DISPARITY_SIGMA, DISPARITY_STEP = 0.05, 0.08, 1 / 32

INTRINSICS = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)


def wall(distance):
    return np.full((240, 320), distance, dtype=np.float32)


def tilted_plane(angle):
    """Depth of a plane through (0, 0, 0.6) whose normal leans by ``angle`` from the optical axis, about x."""
    y = (np.arange(240) - INTRINSICS.cy)[:, None] / INTRINSICS.fy
    depth = 0.6 * np.cos(angle) / (np.cos(angle) - np.sin(angle) * y)
    return np.broadcast_to(depth, (240, 320)).astype(np.float32)


def test_none_copies(rng):
    depth = wall(0.5)
    noisy = add_depth_noise(depth, "none", INTRINSICS, rng)
    assert np.array_equal(noisy, depth) and noisy is not depth


def test_gaussian_has_two_millimetres_and_keeps_missing_pixels(rng):
    depth = wall(0.5)
    depth[:20] = 0
    noisy = add_depth_noise(depth, "gaussian", INTRINSICS, rng)
    assert np.all(noisy[:20] == 0)
    assert np.std(noisy[20:]) == pytest.approx(0.002, rel=0.03)
    assert np.mean(noisy[20:]) == pytest.approx(0.5, abs=1e-4)


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.6])
def test_stereo_error_grows_with_the_square_of_distance(rng, distance):
    noisy = add_depth_noise(wall(distance), "realsense", INTRINSICS, rng)
    steps = np.hypot(DISPARITY_SIGMA, DISPARITY_STEP / np.sqrt(12))
    expected = distance**2 * steps / (INTRINSICS.fx * BASELINE)
    assert np.std(noisy[noisy > 0]) == pytest.approx(expected, rel=0.1)


def test_stereo_depth_comes_in_steps_of_disparity(rng):
    noisy = add_depth_noise(wall(0.6), "realsense", INTRINSICS, rng)
    steps = INTRINSICS.fx * BASELINE / noisy[noisy > 0] / DISPARITY_STEP
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-3)


def test_stereo_loses_few_pixels_of_a_wall_and_many_beside_an_edge(rng):
    depth = wall(0.6)
    lost = np.mean([add_depth_noise(depth, "realsense", INTRINSICS, rng) == 0 for _ in range(5)])
    assert lost == pytest.approx(0.002, rel=0.25)  # without any reason
    depth[:, 160:] = 0.9
    noisy = add_depth_noise(depth, "realsense", INTRINSICS, rng)
    edge = beside_edges(depth)
    assert edge[:, 158:162].all() and not edge[:, :150].any()
    beside = [
        add_depth_noise(depth, "realsense", INTRINSICS, rng)[:, [158, 161]] == 0 for _ in range(5)
    ]  # the two columns at the step itself are lost to grazing incidence too
    assert np.mean(beside) == pytest.approx(0.6, abs=0.06)
    assert np.mean(noisy[edge] == 0) > 0.6
    assert np.mean(noisy[~edge] == 0) < 0.01


def test_stereo_fails_at_grazing_incidence_and_too_close(rng):
    lost = [
        np.mean(add_depth_noise(tilted_plane(np.radians(a)), "realsense", INTRINSICS, rng)[100:140] == 0)
        for a in (50, 78, 85)
    ]
    assert lost[0] < 0.02 < 0.25 < lost[1] < lost[2]
    for outside in (0.1, 0.169, 6.01, 8.0):
        assert not add_depth_noise(wall(outside), "realsense", INTRINSICS, rng).any()
    for within in (0.172, 5.99):
        assert (add_depth_noise(wall(within), "realsense", INTRINSICS, rng) > 0).mean() > 0.9


def test_disparity_error_is_correlated_over_the_matching_window(rng):
    """White noise blurred with σ = 1 px has the autocorrelation exp(-d² / 4), less quantisation."""
    noisy = add_depth_noise(wall(0.3), "realsense", INTRINSICS, rng)
    error = np.where(noisy > 0, INTRINSICS.fx * BASELINE / np.maximum(noisy, 0.1) - 50.0, 0.0)
    correlation = [(error[:, d:] * error[:, :-d]).mean() / (error**2).mean() for d in (1, 2, 4)]
    np.testing.assert_allclose(correlation, np.exp(-np.array([1, 4, 16]) / 4), atol=0.06)


@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
def test_incidence_of_a_tilted_plane(degrees):
    angle = incidence(tilted_plane(np.radians(degrees)), INTRINSICS)
    assert np.degrees(angle[119:121, 159:161]).mean() == pytest.approx(degrees, abs=1.0)


@pytest.mark.parametrize("noise", ["gaussian", "realsense"])
def test_same_seed_gives_the_same_noise(noise):
    images = [add_depth_noise(wall(0.5), noise, INTRINSICS, np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(*images)


def test_unknown_noise_lists_the_known_ones(rng):
    with pytest.raises(ValueError, match="none, gaussian, realsense") as caught:
        add_depth_noise.__wrapped__(wall(1.0), "fog", INTRINSICS, rng)
    assert "'fog'" in str(caught.value)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
