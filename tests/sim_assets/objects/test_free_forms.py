"""Free forms: valid solids of their size that stay of their class, with many different sides."""

import numpy as np
import pytest

from sim_assets.objects.bottle import bottle_profile
from sim_assets.objects.can import can_profile
from sim_assets.objects.families import make_solid, sample_parameters
from sim_assets.objects.free_forms import free_form
from sim_assets.objects.household import sample_household


def forms(category, count, seed=0, sample=sample_parameters):
    rng = np.random.default_rng(seed)
    return [free_form(sample(category, "train", rng), rng) for _ in range(count)]


def radius_at(profile, heights):
    """Largest radius of the profile at each height."""
    low, high = profile[:-1], profile[1:]
    found = []
    for z in heights:
        crosses = (low[:, 1] <= z) != (high[:, 1] <= z)
        (r0, z0), (r1, z1) = low[crosses].T, high[crosses].T
        found.append((r0 + (z - z0) / (z1 - z0) * (r1 - r0)).max())
    return np.array(found)


@pytest.mark.parametrize("sample", [sample_parameters, sample_household])
@pytest.mark.parametrize("category", ["can", "bottle"])
def test_solids_are_watertight_and_of_the_size_asked_for(category, sample):
    for p in forms(category, 25, sample=sample):
        mesh = make_solid(p).mesh()
        assert mesh.is_watertight and mesh.volume > 0
        assert mesh.extents[2] == pytest.approx(p.height, abs=1e-3)
        assert mesh.bounds[0, 2] == pytest.approx(0.0, abs=1e-6)
        if p.radii:
            assert mesh.extents[0] / 2 <= p.radius + 0.0015


def test_cans_are_about_as_wide_at_their_ends_and_never_widen_upwards_much():
    for p in forms("can", 200):
        assert min(p.radii) >= 0.64 and max(p.radii) == pytest.approx(1.0)
        assert p.radii[-1] <= 1.07 * p.radii[0], "what widens upwards is a tumbler"
        assert p.kind in ("food", "plain", "canister") and p.seam > 0


def test_bottles_keep_their_neck():
    for p in forms("bottle", 100):
        if p.radii:
            end = radius_at(bottle_profile(p), [p.body_top - 1e-4])[0]
            assert end >= min(p.radius, p.neck_radius / p.aspect) - 5e-4
            assert p.cap_radius < 0.04


def test_sides_cover_waists_bellies_tapers_and_beads():
    shapes = {"waist": 0, "belly": 0, "taper": 0, "beads": 0}
    for p in forms("can", 200):
        r = radius_at(can_profile(p), np.linspace(0.2, 0.8, 60) * p.height) / p.radius
        turns = np.count_nonzero(np.diff(np.sign(np.diff(r)[np.abs(np.diff(r)) > 1e-5])))
        shapes["beads"] += turns > 5
        shapes["waist"] += turns <= 2 and r[30] < min(r[0], r[-1]) - 0.04
        shapes["belly"] += turns <= 2 and r[30] > max(r[0], r[-1]) + 0.04
        shapes["taper"] += turns <= 2 and r[0] - r[-1] > 0.1
    assert min(shapes.values()) >= 8, shapes


def test_mugs_bowls_and_tumblers_stay_as_they_are():
    rng = np.random.default_rng(2)
    for category in ("mug", "bowl"):
        p = sample_parameters(category, "train", rng)
        assert free_form(p, rng) is p
    tumblers = [p for p in forms("bottle", 100) if p.kind == "tumbler"]
    assert tumblers and not any(p.radii for p in tumblers)
