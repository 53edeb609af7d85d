"""Handle curves and their attachment to a straight mug in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from sim_assets.objects.handles import POINTS, HandleParameters, make_handle, unit_curve
from sim_assets.objects.profiles import radial_crossings
from sim_assets.objects.vessel import Wall, make_vessel

R, H = 0.04, 0.1
VESSEL = make_vessel(np.stack([np.full(21, R), np.linspace(0, H, 21)], axis=1), H, Wall(0.004, 0.004, 0.005))
SQUARE = HandleParameters(
    style="c", curve="superellipse", shape=2.0, apex=0.0, depth=0.03, top=0.08, bottom=0.03,
    thickness=0.008, width=0.012, taper=0.8, root=0.5, exponent=2.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("curve", "shape"),
    [("superellipse", 2.5), ("ring", 4.2), ("slanted", 0.5), ("bezier", 0.4), ("rectangle", 0.2)],
)
def test_unit_curves_run_from_upper_to_lower_root_one_unit_outwards(curve, shape):
    points = unit_curve(replace(SQUARE, curve=curve, shape=shape))
    np.testing.assert_allclose(points[[0, -1]], [(0, 1), (0, -1)], atol=1e-9)
    assert points[:, 0].max() == pytest.approx(1.0) and points[:, 0].min() > -1e-9


def test_superellipse_satisfies_its_equation_and_the_apex_is_raised():
    points = unit_curve(replace(SQUARE, shape=3.0))
    np.testing.assert_allclose(points[:, 0] ** 3 + np.abs(points[:, 1]) ** 3, 1.0, rtol=1e-4)
    raised = unit_curve(replace(SQUARE, apex=0.3))
    assert raised[raised[:, 0].argmax(), 1] == pytest.approx(0.3, abs=0.01)


def test_ring_is_an_arc_of_a_circle_of_its_angle():
    """Radius 1 / sin(α/2) of the half span; its centre lies cos(α/2) times that beyond the roots."""
    half = 2.1
    points = unit_curve(replace(SQUARE, curve="ring", shape=2 * half))
    reach = (1 - np.cos(half)) / np.sin(half)  # the unit of a in half spans
    metric = points * (reach, 1.0)
    centre = np.array([-np.cos(half) / np.sin(half), 0.0])
    np.testing.assert_allclose(np.linalg.norm(metric - centre, axis=1), 1 / np.sin(half), rtol=1e-3)


def radius_at(points, height):
    """a of the outermost crossing at a height b."""
    return radial_crossings(points, np.array([height]))[0, 0]


def test_slanted_handle_has_a_straight_upper_arm_and_upright_and_a_lower_arm_of_its_slope():
    points = unit_curve(replace(SQUARE, curve="slanted", shape=0.5))
    np.testing.assert_allclose([radius_at(points, b) for b in (0.3, 0.1)], 1.0)
    lower = points[(points[:, 0] < 0.5) & (points[:, 1] < 0)]
    np.testing.assert_allclose(lower[:, 1], -1 + 0.5 * lower[:, 0], atol=1e-9)
    assert points[1, 1] == 1.0 and points[1, 0] == pytest.approx(0.55, abs=0.1)


def test_rectangle_leans_outwards_at_the_top():
    """Between the fillets a is proportional to 1 + lean b / 2."""
    points = unit_curve(replace(SQUARE, curve="rectangle", shape=0.4))
    ratio = radius_at(points, 0.4) / radius_at(points, -0.4)
    assert ratio == pytest.approx((1 + 0.2 * 0.4) / (1 - 0.2 * 0.4), rel=1e-3)
    assert points[1, 1] == 1.0 and points[-2, 1] == -1.0


def test_bezier_follows_its_control_points():
    """At t = 1/2 a cubic is (p0 + 3 p1 + 3 p2 + p3) / 8."""
    points = unit_curve(replace(SQUARE, curve="bezier", shape=0.4))
    control = np.array([(0, 1), (1.5, 1.35), (1.2, -0.4), (0, -1)])
    middle = (np.array([1, 3, 3, 1]) / 8) @ control
    largest = max(((1 - t) ** 2 * t * 4.5 + (1 - t) * t**2 * 3.6) for t in np.linspace(0, 1, 120))
    assert np.linalg.norm(points - middle / (largest, 1.0), axis=1).min() < 0.02


def test_handle_starts_in_the_wall_and_reaches_its_depth():
    handle = make_handle(SQUARE, VESSEL)
    line = handle.centreline
    assert line.shape == (POINTS, 2)
    assert line[:, 0].max() == pytest.approx(R + 0.03, abs=2e-4)
    np.testing.assert_allclose(line[[0, -1]], [(R - 0.0064, 0.08), (R - 0.0064, 0.03)], atol=1e-9)
    assert make_handle(replace(SQUARE, thickness=0.004), VESSEL).centreline[0, 0] == pytest.approx(R - 0.004)
    np.testing.assert_allclose([line[:, 1].min(), line[:, 1].max()], (0.03, 0.08), atol=1e-9)


def test_section_is_thicker_at_the_roots_and_tapers_downwards():
    """(1 + (s + 1)/2 (taper - 1)) (1 + root s⁶) for s from -1 at the upper to 1 at the lower root."""
    handle = make_handle(SQUARE, VESSEL)
    np.testing.assert_allclose(handle.thickness[[0, -1]], (0.004 * 1.5, 0.004 * 1.5 * 0.8))
    np.testing.assert_allclose(handle.width, handle.thickness * 1.5)
    assert handle.thickness[POINTS // 2] == pytest.approx(0.004 * 0.9, rel=0.02)
    assert handle.exponent == 2.0
