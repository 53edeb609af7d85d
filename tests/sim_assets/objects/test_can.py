"""Cans: profiles of the test kinds in closed form."""

import numpy as np
import pytest

from sim_assets.objects.can import BENDS, KINDS, SLIGHT_BENDS, CanParameters, can_profile, sample_can
from sim_assets.objects.profiles import radial_crossings


def can(kind, bend=0.2):
    return CanParameters(kind, 0.035, 0.12, 0.001, 0.003, 0.0, 0.001, 0.003, 0.0, 0.0, bend, 700.0)


def radii(kind, heights):
    return radial_crossings(can_profile(can(kind)), np.array(heights))[:, 0]


def test_waisted_keg_and_tapered_bodies_follow_their_curves():
    low, middle, high = 0.006, 0.06, 0.114
    waisted, keg, tapered = (radii(kind, (low, middle, high)) for kind in ("waisted", "keg", "tapered"))
    assert waisted[1] == pytest.approx(0.8 * 0.034, abs=2e-4) and min(waisted[[0, 2]]) > 0.033
    assert keg[1] == pytest.approx(0.035, abs=1e-4) and max(keg[[0, 2]]) < 0.0305
    assert tapered[1] == pytest.approx(0.9 * 0.034, abs=2e-4) and tapered[0] > tapered[1] > tapered[2]


def test_beads_have_their_depth():
    r = radii("beaded", np.linspace(0.02, 0.10, 200))
    assert r.max() == pytest.approx(0.034, abs=2e-4) and r.min() == pytest.approx(0.8 * 0.034, abs=1e-3)


def test_ribs_are_finer_than_beads_and_end_at_the_same_radius():
    heights = np.linspace(0.02, 0.10, 2000)
    ribbed, beaded = (
        radial_crossings(can_profile(can(kind, 0.03)), heights)[:, 0] for kind in ("ribbed", "beaded")
    )
    turns = [np.count_nonzero(np.diff(np.sign(np.diff(r))) != 0) for r in (ribbed, beaded)]
    assert turns[0] > 2 * turns[1] > 4
    assert ribbed.max() == pytest.approx(0.034, abs=2e-4)


@pytest.mark.parametrize("kind", [*KINDS["test"], *SLIGHT_BENDS])
def test_profile_is_as_high_and_wide_as_its_parameters(kind):
    profile = can_profile(can(kind))
    assert profile[:, 1].max() == pytest.approx(0.12, abs=1e-4)
    assert profile[:, 0].max() == pytest.approx(0.035, abs=3e-4)


def test_only_test_kinds_are_curved():
    rng = np.random.default_rng(0)
    assert all(sample_can("train", rng).bend == 0 for _ in range(100))
    for p in (sample_can("test", rng) for _ in range(100)):
        assert BENDS[p.kind][0] <= p.bend <= BENDS[p.kind][1]
