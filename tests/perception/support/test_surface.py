"""Distances from the outline of a surface."""

import numpy as np
import pytest

from perception.detection.geometry import plan_coordinates
from perception.support.surface import SupportSurface
from perception.types import SupportPlane

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
POINTS = np.array([[0.5, 0.5, 3.0], [1.1, 0.5, -2.0], [0.5, -0.2, 0.0], [0.9, 0.5, 0.0]])


def test_points_are_judged_in_plan_view():
    surface = SupportSurface(SupportPlane(), SQUARE)
    np.testing.assert_allclose(surface.beyond(POINTS), [-0.5, 0.1, 0.2, -0.1])


def test_nothing_lies_beyond_an_unknown_extent():
    assert (SupportSurface(SupportPlane()).beyond(POINTS) == -np.inf).all()
    assert SupportSurface(SupportPlane()).corners.shape == (0, 3)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.5, 0.8), (0.0, -0.8, -0.6)])
def test_corners_lie_on_the_plane_at_the_outline(normal):
    unit = np.array(normal) / np.linalg.norm(normal)
    surface = SupportSurface(SupportPlane(unit, 0.4), SQUARE)
    np.testing.assert_allclose(surface.plane.height_above(surface.corners), 0, atol=1e-12)
    np.testing.assert_allclose(plan_coordinates(surface.corners, surface.plane), SQUARE, atol=1e-12)
    np.testing.assert_allclose(surface.beyond(surface.corners), 0, atol=1e-12)
