"""Surfaces: every name paints a texture of its kind of colours; atlases place them in their cells."""

import numpy as np
import pytest

from sim_assets.rendering.surfaces import ATLAS_SIZE, PAINTERS, atlas, surface

SIZE = (64, 96)


@pytest.mark.parametrize("name", [*PAINTERS, "any", "unheard of"])
def test_every_surface_has_its_size_and_repeats_with_its_seed(name):
    images = [surface(name, np.random.default_rng(seed), SIZE) for seed in (0, 0, 1)]
    assert images[0].shape == (*SIZE, 3) and images[0].dtype == np.uint8
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def mean_color(name, seed):
    return surface(name, np.random.default_rng(seed), SIZE).mean(axis=(0, 1))


def test_things_have_their_natural_colours():
    for seed in range(15):
        red, green, blue = mean_color("leaf", seed)
        assert green > red and green > blue
        red, green, blue = mean_color("wood", seed)
        assert red > green > blue
        red, green, blue = mean_color("skin", seed)
        assert red > green > blue
        assert mean_color("black", seed).max() < 70 < 180 < mean_color("white", seed).min()
        assert np.ptp(mean_color("card", seed)) > 20


def test_an_atlas_paints_each_cell_with_its_surface():
    image = atlas(("leaf", "black", "white", "print", "print", "print"), np.random.default_rng(0))
    assert image.shape == (*ATLAS_SIZE, 3)
    rows, columns = ATLAS_SIZE[0] // 2, ATLAS_SIZE[1] // 3
    cells = [image[:rows, i * columns : (i + 1) * columns].mean(axis=(0, 1)) for i in range(3)]
    assert cells[0].argmax() == 1 and cells[1].max() < 70 and cells[2].min() > 180
    upper = image[rows:]
    assert len(np.unique(upper.reshape(-1, 3), axis=0)) > 10
    np.testing.assert_array_equal(
        atlas(("leaf",), np.random.default_rng(4)), atlas(("leaf",), np.random.default_rng(4))
    )


def test_wild_atlases_paint_anything():
    tame = [atlas(("leaf",), np.random.default_rng(seed))[:128, :128] for seed in range(12)]
    wild = [atlas(("leaf",), np.random.default_rng(seed), wild=1.0)[:128, :128] for seed in range(12)]
    green = [[image.mean(axis=(0, 1)).argmax() == 1 for image in images] for images in (tame, wild)]
    assert all(green[0]) and sum(green[1]) < 10
