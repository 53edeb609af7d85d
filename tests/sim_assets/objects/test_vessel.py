"""Vessels: volumes, wall thickness, fillets and feet of a straight cup in closed form."""

import numpy as np
import pytest

from sim_assets.objects.profiles import radial_crossings
from sim_assets.objects.vessel import Wall, make_vessel

R, H = 0.04, 0.09
SIDE = np.stack([np.full(31, R), np.linspace(0.0, H, 31)], axis=1)


def cup(height=H, **wall):
    return make_vessel(SIDE, height, Wall(**{"base": 0.004, "rim": 0.004, "floor": 0.006} | wall))


def test_volume_is_wall_floor_and_half_round_rim():
    """π R² h less the cavity π (R - t)² (h - floor), less t² (1/2 - π/8) of section around the rim."""
    t, floor = 0.004, 0.006
    expected = np.pi * (R**2 * H - (R - t) ** 2 * (H - floor))
    expected -= 2 * np.pi * (R - t / 2) * t**2 * (0.5 - np.pi / 8)
    assert cup().lathe.mesh(around=256).volume == pytest.approx(expected, rel=5e-3)


def test_height_floor_and_radii():
    vessel = cup()
    assert (vessel.height, vessel.floor, vessel.radius) == pytest.approx((H, 0.006, R))
    np.testing.assert_allclose(vessel.outer_radius(np.array([0.01, 0.05])), R)
    np.testing.assert_allclose(vessel.inner_radius(np.array([0.02, 0.05])), R - 0.004)
    np.testing.assert_allclose(vessel.core[5:-10, 0], R - 0.002, atol=1e-6)
    assert vessel.core[0, 1] == pytest.approx(0.006) and vessel.core[-1, 1] == pytest.approx(H)


def test_height_is_met_exactly_by_stretching():
    assert cup(height=0.12).height == pytest.approx(0.12)
    assert cup(height=0.12, foot_height=0.005, foot_ring=0.004).height == pytest.approx(0.12)


def test_thickness_runs_linearly_from_base_to_rim():
    vessel = cup(base=0.006, rim=0.002)
    z = np.array([0.25, 0.5, 0.75]) * H
    thickness = vessel.outer_radius(z) - vessel.inner_radius(z)
    np.testing.assert_allclose(thickness, (0.005, 0.004, 0.003), atol=2e-4)


def test_fillets_are_quarter_circles():
    """At height z a fillet f of a vertical wall recedes by f - sqrt(f² - (f - z)²)."""
    f, g = 0.02, 0.012
    vessel = cup(base_fillet=f, inner_fillet=g)
    z = np.array([0.25, 0.5, 1.0])

    def receding(radius):
        return radius - np.sqrt(radius**2 - (radius * (1 - z)) ** 2)

    np.testing.assert_allclose(R - vessel.outer_radius(f * z), receding(f), atol=5e-4)
    inner = vessel.inner_radius(0.006 + g * z)
    np.testing.assert_allclose(R - 0.004 - inner, receding(g), atol=5e-4)


@pytest.mark.parametrize(("ring", "hollow"), [(0.006, True), (0.0, False), (0.03, False)])
def test_foot_is_a_ring_or_a_disc(ring, hollow):
    """A ring wider than 60 % of the radius is a disc; the hollow under the base is 0.8 of the foot high."""
    vessel = cup(foot_height=0.005, foot_ring=ring)
    assert vessel.floor == pytest.approx(0.005 + 0.006)
    low, high = radial_crossings(vessel.profile, np.array([0.0025, 0.0045]))
    np.testing.assert_allclose(low[low > 0], [R, R - ring] if hollow else [R], atol=3e-4)
    np.testing.assert_allclose(high[high > 0], [R], atol=3e-4)
    assert vessel.outer_radius(np.array([0.001]))[0] == pytest.approx(R, abs=1e-4)


def test_curves_rise_and_the_rim_is_their_common_end():
    for wall in ({}, {"base_fillet": 0.03, "inner_fillet": 0.02}, {"foot_height": 0.004, "foot_ring": 0.005}):
        vessel = cup(**wall)
        assert (np.diff(vessel.inner[:, 1]) > 0).all() and (np.diff(vessel.outer[:, 1]) > 0).all()
        np.testing.assert_allclose(vessel.inner[-1], vessel.outer[-1], atol=1e-9)
        assert vessel.inner[-1, 0] == pytest.approx(R - 0.002, abs=3e-4)
        assert vessel.lathe.mesh().is_watertight
