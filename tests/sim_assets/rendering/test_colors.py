"""Colours: the palette's neighbourhood, bytes, mixtures."""

import colorsys

import numpy as np

from sim_assets.rendering.colors import _PALETTE, any_color, mixed, random_color, to_bytes, to_tuple


def test_colours_keep_near_the_palette_unless_any_is_asked_for():
    rng = np.random.default_rng(0)
    palette = np.array([colorsys.hsv_to_rgb(*entry) for entry in _PALETTE])

    def distance(color):
        return np.abs(palette - color).max(axis=1).min()

    near = [distance(random_color(rng, False)) for _ in range(200)]
    far = [distance(random_color(rng, True)) for _ in range(200)]
    assert max(near) < 0.3 and np.median(near) < 0.1 < np.median(far)


def test_any_colour_includes_grey_dark_and_saturated_ones():
    rng = np.random.default_rng(1)
    colors = np.array([any_color(rng) for _ in range(500)])
    assert colors.min() >= 0 and colors.max() <= 1
    spread = np.ptp(colors, axis=1)
    assert spread.min() < 0.03 and spread.max() > 0.8 and colors.max(axis=1).min() < 0.1


def test_bytes_and_mixtures():
    assert to_bytes((1.0, 0.5, 0.0)).tolist() == [255, 128, 0] and to_bytes((2, -1, 0)).tolist() == [
        255,
        0,
        0,
    ]
    assert to_tuple(to_bytes((0, 0, 1))) == (0, 0, 255)
    image = mixed((1, 0, 0), (0, 0, 1), np.array([[True, False]]))
    assert image.tolist() == [[[0, 0, 255], [255, 0, 0]]] and image.dtype == np.uint8
