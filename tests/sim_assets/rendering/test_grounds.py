"""Grounds: each kind in its colours, all kinds drawn, the same for the same seed."""

import numpy as np
import pytest

from sim_assets.rendering import grounds
from sim_assets.rendering.grounds import cardboard, random_ground, wood


def test_wood_and_cardboard_keep_their_colour_with_little_contrast():
    color = (0.6, 0.45, 0.3)
    for make, contrast in ((wood, 0.15), (cardboard, 0.03)):
        image = make(np.random.default_rng(0), color) / 255
        np.testing.assert_allclose(image.mean(axis=(0, 1)), color, rtol=0.1)
        assert 0.005 < (image[..., 0] / color[0]).std() < contrast
    planks = wood(np.random.default_rng(0), color).astype(float).mean(axis=(1, 2))
    joints = np.linspace(0, 512, 7).astype(int)[:-1]
    assert (planks[joints] < 0.85 * planks.mean()).all()


@pytest.mark.parametrize("kind", grounds._GROUNDS)
def test_every_ground_has_its_size_and_repeats_with_its_seed(kind):
    images = [kind(np.random.default_rng(seed), (64, 48)) for seed in (0, 0, 1)]
    assert images[0].shape == (64, 48, 3) and images[0].dtype == np.uint8
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()


def test_grounds_are_of_many_kinds_and_repeat_with_their_seed():
    drawn = [random_ground(np.random.default_rng(seed), (64, 48)) for seed in range(60)]
    colors = [len(np.unique(ground.reshape(-1, 3), axis=0)) for ground in drawn]
    assert 1 in colors and 2 in colors and max(colors) > 100  # paint, tiles, wood or stone
    assert np.array_equal(drawn[4], random_ground(np.random.default_rng(4), (64, 48)))


def test_shares_of_the_grounds_add_up():
    assert sum(grounds._GROUND_SHARES) == pytest.approx(1) and len(grounds._GROUNDS) == 12
