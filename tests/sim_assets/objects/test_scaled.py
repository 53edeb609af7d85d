"""Scaled objects are similar to their originals."""

import numpy as np
import pytest

from sim_assets.objects import sample_object
from sim_assets.objects.model import LIGHTEST
from sim_assets.objects.scaled import scaled


@pytest.mark.parametrize("category", ["mug", "can"])
def test_lengths_volumes_and_inside_tests_scale(category):
    model = sample_object(category, "test", np.random.default_rng(1))
    small = scaled(model, 0.7)
    assert (small.height, small.radius) == pytest.approx((0.7 * model.height, 0.7 * model.radius))
    assert small.mesh.volume == pytest.approx(0.7**3 * model.mesh.volume)
    assert small.mass == pytest.approx(max(0.7**3 * model.mass, LIGHTEST))
    points = np.random.default_rng(0).uniform(*model.shape.bounds, (500, 3))
    np.testing.assert_array_equal(small.inside(0.7 * points), model.inside(points))
    vertices = np.asarray(model.mesh.vertices)
    np.testing.assert_array_equal(small.is_handle(0.7 * vertices), model.is_handle(vertices))


def test_collision_pieces_stay_within_the_mesh():
    model = sample_object("mug", "test", np.random.default_rng(2))
    small = scaled(model, 0.5)
    for piece, original in zip(small.collision, model.collision, strict=True):
        np.testing.assert_allclose(piece.vertices, 0.5 * original.vertices)
        np.testing.assert_allclose(piece.position, 0.5 * original.position)
    assert np.abs(model.mesh.bounds).max() > 0.03  # the original is not changed


def test_scale_one_is_the_same_object():
    model = sample_object("can", "test", np.random.default_rng(3))
    assert scaled(model, 1.0) is model
