"""Every kind: a finite mesh of its size, outward surfaces, few triangles, textured, repeatable."""

import numpy as np
import pytest

from sim_assets.datasets.distractors import basic


@pytest.mark.parametrize("kind", dict.fromkeys(basic.KINDS))
def test_kind(kind, check_kind):
    check_kind(kind, largest=0.5)


def test_random_parts_rest_on_the_table():
    rng = np.random.default_rng(3)
    for _ in range(30):
        mesh = basic.random_parts(rng)
        assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)
        assert mesh.extents.min() > 0.002 and mesh.extents.max() < 0.45


def test_a_lump_is_closed_and_not_round():
    """Its vertices do not spread alike across its longest direction, as those of bottles and cans do."""
    rng = np.random.default_rng(5)
    ratios = []
    for _ in range(20):
        lump = basic._lump(rng)
        assert lump.is_watertight and lump.volume > 0
        spread = np.linalg.eigvalsh(np.cov(lump.vertices.T))
        ratios.append(spread[1] / spread[2])
    assert np.median(ratios) < 0.75


def test_a_book_is_as_thick_as_asked():
    parts = basic.book(0.12, 0.2, 0.03)
    bounds = np.array([part.bounds for part in parts])
    np.testing.assert_allclose(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0), (0.12, 0.2, 0.03))
