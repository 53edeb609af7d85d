"""Mugs: body curves at their characteristic heights."""

import numpy as np
import pytest

from sim_assets.objects.mug import _relative_radius, mug_vessel, sample_mug


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("conical", (0.8, 0.9, 1.0)),
        ("bulged", (0.8, 1.0, 0.8)),
        ("waisted", (1.0, 0.8, 1.0)),
        ("barrel", (0.8, 1 - 0.2 * (0.12 / 0.62) ** 2, 1 - 0.2 * (0.38 / 0.62) ** 2)),
        ("stepped", (0.8, 1.0, 1.0)),
    ],
)
def test_radius_at_base_middle_and_rim(body, expected):
    np.testing.assert_allclose(_relative_radius(body, 0.2, np.array([0.0, 0.5, 1.0])), expected)


@pytest.mark.parametrize("split", ["train", "test"])
def test_cavity_leaves_the_wall_and_the_floor(split):
    rng = np.random.default_rng(0)
    for _ in range(10):
        p = sample_mug(split, rng)
        vessel = mug_vessel(p)
        z = np.linspace(vessel.floor + 0.012, 0.9 * vessel.height, 20)
        assert (vessel.outer_radius(z) - vessel.inner_radius(z)).min() > 0.8 * min(p.wall.base, p.wall.rim)
        assert vessel.floor == pytest.approx(p.wall.floor + p.wall.foot_height)
