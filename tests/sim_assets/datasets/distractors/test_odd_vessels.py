"""Odd vessels: on the table, of a size to stand there, and never round without parts."""

import numpy as np
import pytest

from sim_assets.datasets.distractors import basic
from sim_assets.datasets.distractors.odd_vessels import odd_vessel


@pytest.fixture(scope="module")
def vessels():
    rng = np.random.default_rng(4)
    return [odd_vessel(rng) for _ in range(60)]


def test_they_rest_on_the_table_and_are_textured(vessels):
    for mesh in vessels:
        assert np.isfinite(mesh.vertices).all()
        assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert 0.02 < mesh.extents.max() < 0.7 and len(mesh.faces) < 6000
        assert 1 <= len(mesh.metadata["surfaces"]) <= 2


def test_none_is_a_body_of_revolution(vessels):
    """Seen from above, the vertices do not spread alike in all directions."""
    ratios = []
    for mesh in vessels:
        spread = np.linalg.eigvalsh(np.cov(mesh.vertices[:, :2].T))
        ratios.append(spread[0] / spread[1])
    assert np.quantile(ratios, 0.9) < 0.9 and np.median(ratios) < 0.65


def test_the_same_seed_gives_the_same_vessel():
    first, second = (odd_vessel(np.random.default_rng(8)) for _ in range(2))
    np.testing.assert_array_equal(first.vertices, second.vertices)


def test_random_parts_have_their_share_of_them(monkeypatch):
    drawn = []
    monkeypatch.setattr(basic, "odd_vessel", lambda rng: drawn.append(1) or odd_vessel(rng))
    rng = np.random.default_rng(0)
    for _ in range(100):
        basic.random_parts(rng)
    assert 28 <= len(drawn) <= 52
