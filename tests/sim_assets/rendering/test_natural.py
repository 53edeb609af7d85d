"""Natural textures: directions of grain, variance of noise, clipped mixtures, colours within bounds."""

import numpy as np
import pytest

from sim_assets.rendering.natural import (
    blended,
    bricks,
    fabric,
    hsv,
    marble,
    mottled,
    noise,
    plain,
    tinted,
    veneer,
    wicker,
)


def test_grain_runs_along_the_rows():
    image = veneer(np.random.default_rng(0), (128, 128)).astype(float).mean(axis=2)
    assert np.abs(np.diff(image, axis=0)).mean() > 2 * np.abs(np.diff(image, axis=1)).mean()


def test_noise_has_unit_variance_and_its_direction():
    field = noise(np.random.default_rng(0), (128, 128), 40, 2)
    assert field.shape == (128, 128) and field.std() == pytest.approx(1, rel=1e-3)
    assert np.abs(np.diff(field, axis=0)).mean() > 3 * np.abs(np.diff(field, axis=1)).mean()


def test_mixtures_and_tones_are_clipped():
    assert tinted((1.0, 0.5, 0.0), np.array([[1.0, 2.0]])).tolist() == [[[255, 127, 0], [255, 255, 0]]]
    image = blended((0, 0, 0), (1, 1, 1), np.array([[-1.0, 0.5, 2.0]]))
    assert image[..., 0].tolist() == [[0, 127, 255]]
    color = hsv(np.random.default_rng(0), (0.3, 0.35), (0.8, 0.9), (0.5, 0.6))
    assert max(color) == color[1] and 0.5 <= color[1] <= 0.6
    image = plain(np.random.default_rng(0), (32, 32), (0.5, 0.5, 0.5))
    assert image.mean() == pytest.approx(127, abs=20) and 0 < image.std() < 20


def test_a_mottled_painter_keeps_to_its_bounds():
    paint = mottled((0.3, 0.35), (0.8, 0.9), (0.5, 0.6), fine=0.01, coarse=0.01)
    image = paint(np.random.default_rng(0), (32, 32))
    assert (image.argmax(axis=2) == 1).all() and 115 < image[..., 1].mean() < 160


def test_cloth_stone_canes_and_masonry_have_a_pattern():
    for make in (fabric, marble, wicker, bricks):
        contrast = [make(np.random.default_rng(seed), (64, 64)).std(axis=(0, 1)).max() for seed in range(12)]
        assert max(contrast) > 15
