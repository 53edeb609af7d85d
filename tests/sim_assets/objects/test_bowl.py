"""Bowls: sections and side curves of the test kinds."""

import numpy as np
import pytest

from sim_assets.objects.bowl import SIDES, bowl_section, bowl_solid, bowl_vessel, sample_bowl
from sim_assets.objects.solids import LobedSection, PolygonSection


def bowl(side):
    rng = np.random.default_rng(4)
    while True:
        parameters = sample_bowl("test" if side in SIDES["test"] else "train", rng)
        if parameters.side == side:
            return parameters


@pytest.mark.parametrize("side", [*SIDES["train"], *SIDES["test"]])
def test_vessel_has_the_height_and_radius_of_its_parameters(side):
    parameters = bowl(side)
    vessel = bowl_vessel(parameters)
    assert vessel.height == pytest.approx(parameters.height, abs=1e-4)
    assert vessel.radius == pytest.approx(parameters.radius, rel=0.05)


def test_sections_are_those_of_the_table():
    assert bowl_section(bowl("faceted")) == PolygonSection(8)
    assert bowl_section(bowl("lobed")) == LobedSection(8, 0.06)
    assert all(bowl_section(bowl(side)) is None for side in (*SIDES["train"], "ogee"))


@pytest.mark.parametrize("side", ["faceted", "lobed"])
def test_surface_of_a_sectioned_bowl_is_watertight_and_as_wide_as_its_bounds(side):
    solid = bowl_solid(bowl(side))
    mesh = solid.mesh()
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, solid.bounds, atol=1e-6)


def test_ogee_has_a_waist_below_its_rim():
    vessel = bowl_vessel(bowl("ogee"))
    z = np.linspace(0.3, 0.97, 60) * vessel.height
    assert (np.diff(vessel.outer_radius(z)) < 0).any() and vessel.outer_radius(z)[-1] > 0.9 * vessel.radius
