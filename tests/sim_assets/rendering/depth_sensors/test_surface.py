"""Albedo and highlights of an image, incidence and edges of a depth image, random fields."""

import numpy as np
import pytest

from perception.types import CameraIntrinsics
from sim_assets.rendering.depth_sensors.surface import (
    ALBEDO,
    NEUTRAL,
    box_mean,
    correlated,
    depth_edges,
    incidence,
    patchy,
    ramp,
    surface_of,
)

INTRINSICS = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)


def tilted_plane(angle):
    """Depth of a plane through (0, 0, 0.6) whose normal leans by ``angle`` from the optical axis, about x."""
    y = (np.arange(240) - INTRINSICS.cy)[:, None] / INTRINSICS.fy
    depth = 0.6 * np.cos(angle) / (np.cos(angle) - np.sin(angle) * y)
    return np.broadcast_to(depth, (240, 320)).astype(np.float32)


@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
def test_incidence_of_a_tilted_plane(degrees):
    cosine = incidence(tilted_plane(np.radians(degrees)), INTRINSICS)
    assert np.degrees(np.arccos(cosine[119:121, 159:161])).mean() == pytest.approx(degrees, abs=0.5)


def test_depth_edges_are_neither_inclined_nor_missed():
    depth = np.full((20, 30), 0.6, dtype=np.float32)
    depth[:, 15:] = 0.9
    camera = CameraIntrinsics(30, 20, 300.0, 300.0, 14.5, 9.5)
    assert incidence(depth, camera).min() > 0.99
    edges = depth_edges(depth, 0.02)
    assert edges[:, 14:16].all() and edges.sum() == 2 * 20


@pytest.mark.parametrize("degrees", [40, 70])
def test_a_slope_is_no_edge(degrees):
    assert not depth_edges(tilted_plane(np.radians(degrees))[60:180], 0.02).any()


def test_albedo_follows_brightness_within_its_limits_but_not_that_of_the_room(rng):
    rgb = np.zeros((40, 60, 3), dtype=np.uint8)
    rgb[:, 20:40], rgb[:, 40:] = 100, 200
    albedo = surface_of(rgb, (40, 60), rng).albedo
    assert albedo[0, 0] == pytest.approx(ALBEDO[0])
    assert albedo[0, 0] < albedo[0, 30] < albedo[0, 50] <= ALBEDO[1]
    dim = surface_of((rgb // 2).astype(np.uint8), (40, 60), rng).albedo
    assert dim[0, 50] == pytest.approx(albedo[0, 50], rel=0.02)


def test_highlights_are_bright_spots_not_bright_surfaces(rng):
    rgb = np.full((120, 160, 3), 110, dtype=np.uint8)
    rgb[50:54, 60:64] = 255
    highlight = surface_of(rgb, (120, 160), rng).highlight
    assert highlight[52, 62] == 1 and highlight.sum() <= 16
    assert not surface_of(np.full_like(rgb, 255), (120, 160), rng).highlight.any()


def test_without_colour_surfaces_are_grey_and_matt(rng):
    surface = surface_of(None, (4, 5), rng)
    assert np.all(surface.albedo == np.float32(NEUTRAL)) and not surface.highlight.any()


@pytest.mark.parametrize("pixels", [1, 3, 20])
def test_correlated_noise_is_standard_normal_and_smooth_over_its_length(pixels, rng):
    noise = np.stack([correlated((120, 160), pixels, rng) for _ in range(30)])
    assert noise.shape == (30, 120, 160)
    assert noise.std() == pytest.approx(1, abs=0.12) and abs(noise.mean()) < 0.1
    near = (noise[..., 1:] * noise[..., :-1]).mean()
    far = (noise[..., 3 * pixels :] * noise[..., : -3 * pixels]).mean()
    assert abs(far) < 0.1
    assert near < 0.1 if pixels == 1 else near > 0.5


def test_patches_are_distributed_evenly(rng):
    values = np.stack([patchy((90, 110), 5, rng) for _ in range(10)])
    counts = np.histogram(values, bins=5, range=(0, 1))[0] / values.size
    np.testing.assert_allclose(counts, 0.2, atol=0.05)


def test_ramp_and_mean():
    np.testing.assert_allclose(ramp(np.array([[0.0, 1, 2, 3, 4]]), 3, 1), [[1, 1, 0.5, 0, 0]])
    image = np.zeros((5, 5), dtype=np.float32)
    image[2, 2] = 9
    assert box_mean(image, 3)[1, 1] == pytest.approx(1)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
