"""Depth noise: the constant model, the choice of a sensor, determinism and sizes."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_noise import DEPTH_NOISES, add_depth_noise, nearest_depth

INTRINSICS = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
SENSORS = ("realsense", "kinect", "tof")


def wall(distance):
    return np.full((240, 320), distance, dtype=np.float32)


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


@pytest.mark.parametrize("noise", ["gaussian", *SENSORS])
def test_same_seed_gives_the_same_noise_and_another_seed_another(noise):
    images = [add_depth_noise(wall(0.7), noise, INTRINSICS, np.random.default_rng(s)) for s in (3, 3, 4)]
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


@pytest.mark.parametrize("noise", SENSORS)
@pytest.mark.parametrize("shape", [(480, 640), (121, 163), (33, 41), (7, 5), (1, 1)])
def test_any_size_keeps_its_shape_and_invents_no_depth(noise, shape, rng):
    height, width = shape
    intrinsics = CameraIntrinsics(
        width, height, 0.94 * width, 0.94 * width, (width - 1) / 2, (height - 1) / 2
    )
    depth = np.full(shape, 0.8, dtype=np.float32)
    depth[: height // 3] = 0
    rgb = rng.integers(60, 180, (*shape, 3)).astype(np.uint8)
    before = depth.copy(), rgb.copy()
    noisy = add_depth_noise(depth, noise, intrinsics, rng, rgb)
    assert noisy.shape == shape and noisy.dtype == np.float32
    assert not noisy[depth == 0].any() and np.isfinite(noisy).all() and (noisy >= 0).all()
    assert np.array_equal(depth, before[0]) and np.array_equal(rgb, before[1])
    if width > 100:
        assert (noisy[height // 2 :] > 0).mean() > 0.8


@pytest.mark.parametrize("noise", SENSORS)
def test_images_without_depth_stay_empty(noise, rng):
    assert not add_depth_noise(np.zeros((60, 80), np.float32), noise, INTRINSICS, rng).any()


@pytest.mark.parametrize("noise", SENSORS)
def test_a_sensor_measures_from_its_nearest_depth_on(noise, rng):
    """A matt wall a little beyond that depth is measured almost everywhere, one at half of it nowhere."""
    camera = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
    far = np.full((120, 160), nearest_depth(noise), np.float32)
    assert (add_depth_noise(far, noise, camera, rng)[20:-20, 30:-30] > 0).mean() > 0.8
    assert not add_depth_noise(far / 2, noise, camera, rng).any()
    assert nearest_depth("none") == nearest_depth("gaussian") == 0


def test_unknown_noise_lists_the_known_ones(rng):
    with pytest.raises(ValueError, match=", ".join(DEPTH_NOISES)) as caught:
        add_depth_noise.__wrapped__(wall(1.0), "fog", INTRINSICS, rng)
    assert "'fog'" in str(caught.value)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
