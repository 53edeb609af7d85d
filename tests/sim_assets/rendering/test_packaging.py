"""Packaging: faces of one brand share its colours, prints have structure, brands differ."""

import numpy as np
import pytest

from sim_assets.rendering.packaging import front, random_brand, side, top, wrapped

SIZE = (128, 128)


@pytest.mark.parametrize("face", [front, side, top])
def test_faces_have_their_size_and_repeat_with_their_seed(face):
    def draw(seed):
        rng = np.random.default_rng(seed)
        return face(random_brand(rng), SIZE, rng)

    assert draw(1).shape == (*SIZE, 3) and draw(1).dtype == np.uint8
    np.testing.assert_array_equal(draw(1), draw(1))
    assert len({draw(seed).tobytes() for seed in range(10)}) == 10


def test_a_front_has_much_more_contrast_than_a_plain_ground():
    edges = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        image = front(random_brand(rng), SIZE, rng).astype(int)
        edges.append((np.abs(np.diff(image, axis=1)).sum(axis=2) > 60).mean())
    assert np.median(edges) > 0.02


def test_sides_and_lids_wear_the_brands_colours():
    seen = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        brand = random_brand(rng)
        for image in (side(brand, SIZE, rng), top(brand, SIZE, rng)):
            seen += (image == brand.ground).all(axis=2).mean() > 0.2
    assert seen > 25


def test_brands_are_mostly_saturated_some_white_some_dark():
    grounds = np.array([random_brand(np.random.default_rng(seed)).ground for seed in range(300)])
    saturated = np.ptp(grounds, axis=1) > 80
    assert 0.4 < saturated.mean() < 0.75
    assert (grounds.min(axis=1) > 170).mean() > 0.1 and (grounds.max(axis=1) < 70).mean() > 0.05


def test_wrapped_prints_repeat_their_front_around():
    image = wrapped((128, 256), np.random.default_rng(0))
    assert image.shape == (128, 256, 3) and len(np.unique(image.reshape(-1, 3), axis=0)) > 5
