"""Time of flight: flying pixels, reflectance, cavities, holes."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors import time_of_flight as tof
from sim_assets.rendering.depth_sensors.time_of_flight import time_of_flight

INTRINSICS = CameraIntrinsics(240, 160, 600.0, 600.0, 119.5, 79.5)


@pytest.fixture
def clean(monkeypatch):
    """No scattering and hardly any noise."""
    monkeypatch.setattr(tof, "SCATTER", (0.0, 0.0))
    monkeypatch.setattr(tof, "NOISE", (1e-5, 0.0, 1e-5))


def wall(distance):
    return np.full((160, 240), distance, dtype=np.float32)


def test_flying_pixels_lie_between_the_two_depths_beside_the_edge_only(rng, clean):
    depth = wall(1.0)
    depth[80:] = 0.6  # a horizontal edge: no shadow
    noisy = time_of_flight(depth, INTRINSICS, rng)
    flying = (noisy > 0.62) & (noisy < 0.98)
    assert not flying[:76].any() and not flying[84:].any()
    assert 0.5 < flying.sum() / 240 < 2.5
    assert noisy[noisy > 0].min() > 0.58 and noisy.max() < 1.02


def test_noise_grows_with_the_square_of_distance_and_with_darkness(rng):
    constant, white, _ = tof.NOISE
    for distance in (0.6, 1.2, 2.0):
        noisy = time_of_flight(wall(distance), INTRINSICS, rng)[40:120, 60:180]
        difference = (noisy[:, 1:] - noisy[:, :-1])[(noisy[:, 1:] > 0) & (noisy[:, :-1] > 0)]
        expected = constant + white * distance**2 / 0.45
        assert difference.std() / np.sqrt(2) == pytest.approx(expected, rel=0.1)


def test_dark_surfaces_look_farther_and_vanish_first(rng, clean):
    rgb = np.full((160, 240, 3), 220, dtype=np.uint8)
    rgb[:, 120:] = 20
    noisy = time_of_flight(wall(0.7), INTRINSICS, rng, rgb)
    light, dark = (np.median(part[part > 0]) for part in (noisy[:, :110], noisy[:, 130:]))
    assert 0.002 < dark - light < 0.008
    lost = time_of_flight(wall(2.8), INTRINSICS, rng, rgb) == 0
    assert lost[:, 130:].mean() > 0.4 and lost[:, :110].mean() < 0.02


def test_cavities_are_rounded_and_planes_are_not(rng, monkeypatch):
    monkeypatch.setattr(tof, "NOISE", (1e-5, 0.0, 1e-5))
    monkeypatch.setattr(tof, "SCATTER", (0.2, 0.2))
    x = np.abs(np.arange(240) - 119.5) / 600
    valley = np.broadcast_to(0.8 / (1 + x), (160, 240)).astype(np.float32)
    lifted = valley - time_of_flight(valley, INTRINSICS, rng)
    middle = np.median(lifted[60:100, 116:124])
    side = np.median(lifted[60:100, 30:60])
    assert middle > side + 5e-4
    y = (np.arange(160) - 79.5)[:, None] / 600
    plane = np.broadcast_to(0.8 / (1 + 0.7 * y), (160, 240)).astype(np.float32)
    error = (time_of_flight(plane, INTRINSICS, rng) - plane)[50:110, 50:-50]
    assert np.abs(error).max() < 0.005


def test_the_colour_camera_sees_what_the_depth_camera_does_not(rng, clean):
    depth = wall(1.2)
    depth[:, 80:160] = 0.6
    lost = time_of_flight(depth, INTRINSICS, rng)[20:140] == 0
    width = 600 * 0.032 * (1 / 0.6 - 1 / 1.2)
    assert np.median(lost[:, 155:190].sum(axis=1)) == pytest.approx(width, abs=2.5)
    assert np.median(lost[:, 50:85].sum(axis=1)) <= 2


def test_what_is_out_of_range_is_not_measured(rng):
    for outside in (0.2, 5.8):
        assert not time_of_flight(wall(outside), INTRINSICS, rng).any()


@pytest.fixture
def rng():
    return np.random.default_rng(0)
