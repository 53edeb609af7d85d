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


def test_a_book_is_as_thick_as_asked():
    parts = basic.book(0.12, 0.2, 0.03)
    bounds = np.array([part.bounds for part in parts])
    np.testing.assert_allclose(bounds[:, 1].max(axis=0) - bounds[:, 0].min(axis=0), (0.12, 0.2, 0.03))
