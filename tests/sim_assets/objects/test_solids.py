"""Sections and solids: closed-form radii, bounds, volumes."""

import numpy as np
import pytest

from sim_assets.objects.solids import Lathe, LobedSection, PolygonSection, SuperellipseSection

CYLINDER = np.array([(0.0, 0.0), (0.05, 0.0), (0.05, 0.1), (0.0, 0.1)])


def radius(section, azimuth):
    return 1.0 + section.modulation(np.cos(azimuth), np.sin(azimuth))


def test_polygon_has_corners_on_the_axes_and_flat_facets():
    octagon = PolygonSection(8)
    corners = np.arange(8) * np.pi / 4
    np.testing.assert_allclose(radius(octagon, corners), 1.0)
    np.testing.assert_allclose(radius(octagon, corners + np.pi / 8), np.cos(np.pi / 8))
    azimuths = np.linspace(0.05, np.pi / 4 - 0.05, 9)  # distance along the facet's normal is constant
    np.testing.assert_allclose(radius(octagon, azimuths) * np.cos(azimuths - np.pi / 8), np.cos(np.pi / 8))


def test_lobes_lie_on_the_axes_and_valleys_between():
    lobes = LobedSection(8, 0.06)
    np.testing.assert_allclose(radius(lobes, np.arange(8) * np.pi / 4), 1.0)
    np.testing.assert_allclose(radius(lobes, np.arange(8) * np.pi / 4 + np.pi / 8), 0.94)


def test_superellipse_turns_round_at_the_neck():
    section = SuperellipseSection(0.5, 2.0, 0.02, 0.06)
    np.testing.assert_allclose(section.weight(np.array([0.0, 0.02, 0.04, 0.06, 0.1])), [1, 1, 0.5, 0, 0])
    np.testing.assert_allclose(radius(section, np.array([0.0, np.pi / 2])), [1.0, 0.5])


@pytest.mark.parametrize(
    ("section", "area"),
    [
        (None, np.pi),
        (PolygonSection(8), 2 * np.sqrt(2)),
        (LobedSection(8, 0.06), np.pi * (0.97**2 + 0.03**2 / 2)),
        (SuperellipseSection(0.5, 2.0, 1.0, 2.0), np.pi / 2),
    ],
)
def test_mesh_volume_inside_test_and_bounds_agree_with_the_section(section, area):
    lathe = Lathe(CYLINDER, section)
    mesh = lathe.mesh(around=160)
    assert mesh.is_watertight and mesh.volume == pytest.approx(area * 0.05**2 * 0.1, rel=3e-3)
    np.testing.assert_allclose(mesh.bounds, lathe.bounds, atol=1e-9)
    points = np.random.default_rng(0).uniform(*lathe.bounds, (20_000, 3))
    box = np.prod(np.ptp(lathe.bounds, axis=0))
    assert lathe.inside(points).mean() * box == pytest.approx(mesh.volume, rel=0.03)
