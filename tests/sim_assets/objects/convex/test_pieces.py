"""Primitives of collision pieces and polylines of curves in closed form."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from sim_assets.objects.convex.pieces import CLEARANCE, breakpoints, cylinder, frustum, hull
from sim_assets.objects.solids import PolygonSection


def test_breakpoints_find_the_corner():
    corner = np.concatenate([np.linspace((0, 0), (1, 0), 11), np.linspace((1, 0.1), (1, 1), 10)])
    np.testing.assert_array_equal(breakpoints(corner, 0.01, most=4), [0, 10, 20])
    np.testing.assert_array_equal(breakpoints(corner, 0.01, most=1), [0, 20])


@pytest.mark.parametrize("tolerance", [0.1, 0.01, 0.001])
def test_breakpoints_of_an_arc_stay_within_the_tolerance(tolerance):
    angle = np.linspace(0, np.pi, 400)
    arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    chosen = breakpoints(arc, tolerance, most=99)
    sagitta = 1 - np.cos(np.diff(angle[chosen]) / 2)
    assert sagitta.max() <= tolerance + 1e-4 and len(chosen) < 2 + 2 * np.pi / np.sqrt(2 * tolerance)
    assert len(breakpoints(arc, 1e-6, most=5)) == 6


def test_cylinder_reaches_from_bottom_to_top():
    piece = cylinder(0.03, 0.01, 0.05)
    np.testing.assert_allclose(piece.position, (0, 0, 0.03))
    assert piece.kind == "cylinder" and piece.size == pytest.approx((0.03, 0.02))
    np.testing.assert_array_equal(piece.quat_wxyz, (1, 0, 0, 0))


def test_frustum_has_the_volume_of_its_cone():
    """π h (r² + r R + R²) / 3: corners lie outside the circle, edges inside."""
    piece = frustum((0.04, 0.0), (0.02, 0.1))
    np.testing.assert_allclose([piece.vertices[:, 2].min(), piece.vertices[:, 2].max()], (0.0, 0.1))
    volume = np.pi * 0.1 * (0.04**2 + 0.04 * 0.02 + 0.02**2) / 3
    assert ConvexHull(piece.vertices).volume == pytest.approx(volume, rel=3e-3)
    assert piece.kind == "mesh" and not piece.position.any()


def test_frustum_follows_its_section_with_corners_at_the_phase():
    piece = frustum((0.04, 0.0), (0.04, 0.1), PolygonSection(4), around=8, phase=0.0)
    assert ConvexHull(piece.vertices).volume == pytest.approx(2 * 0.04**2 * 0.1)
    np.testing.assert_allclose(piece.vertices[0], (0.04, 0, 0), atol=1e-12)


def test_hull_keeps_its_corners_in_the_object_frame():
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], dtype=float)
    np.testing.assert_array_equal(hull(corners).vertices, corners)
    assert hull(corners).size == () and CLEARANCE == 0.0018
