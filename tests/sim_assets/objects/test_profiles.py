"""Profiles against hand-computed numbers, turned bodies and swept handles against closed forms."""

import numpy as np
import pytest

from sim_assets.objects.profiles import (
    body_curve,
    fillet,
    inside_profile,
    radial_crossings,
    resample,
    soften,
    superellipse_arc,
)
from sim_assets.objects.solids import Handle, Lathe, SuperellipseSection

CUP = np.array([(0, 0), (3, 0), (3, 4), (2, 4), (2, 1), (0, 1)], dtype=float)  # walls 2..3, floor 0..1


def test_crossings_of_a_cup():
    crossings = radial_crossings(CUP, np.array([-0.5, 0.5, 2.0, 4.5]))
    np.testing.assert_allclose(crossings, [[0, 0], [3, 0], [3, 2], [0, 0]])


@pytest.mark.parametrize(
    ("r", "z", "inside"),
    [
        (0.0, 0.5, True),
        (2.9, 0.5, True),
        (1.0, 2.0, False),
        (2.5, 2.0, True),
        (3.1, 2.0, False),
        (2.5, 4.1, False),
    ],
)
def test_cup_has_a_cavity(r, z, inside):
    assert inside_profile(CUP, np.array([r]), np.array([z]))[0] == inside


def test_fillet_of_a_right_angle_is_its_circle():
    rounded = fillet(
        np.array([(0, 0), (10, 0), (10, 10)], dtype=float), np.array([0.0, 2.0, 0.0]), segments=8
    )
    arc = rounded[1:-1]
    np.testing.assert_allclose(np.linalg.norm(arc - (8, 2), axis=1), 2.0)
    np.testing.assert_allclose(arc[[0, -1]], [(8, 0), (10, 2)], atol=1e-12)


def test_fillet_too_large_for_its_edges_shrinks():
    rounded = fillet(np.array([(0, 0), (1, 0), (1, 1)], dtype=float), np.array([0.0, 50.0, 0.0]))
    assert rounded.min() >= 0 and rounded.max() <= 1


def test_soften_keeps_gentle_turns():
    gentle = np.array([(0, 0), (1, 0.1), (2, 0.3)])
    np.testing.assert_array_equal(soften(gentle, 0.2), gentle)


def test_body_curves_pass_through_their_radii_and_stay_between_them():
    radii = (1.0, 0.8, 0.9, 0.9)
    np.testing.assert_allclose(body_curve(radii, np.linspace(0, 1, 4)), radii)
    fine = body_curve(radii, np.linspace(0, 1, 100))
    assert fine.min() == pytest.approx(0.8, abs=1e-3) and fine.max() == 1.0
    np.testing.assert_allclose(body_curve((0.7, 1.0), np.array([0.5])), 0.85)


def test_resample_steps_evenly():
    even = resample(superellipse_arc(4.0), 30)
    steps = np.hypot(*np.diff(even, axis=0).T)
    assert steps.max() / steps.min() < 1.05


def test_turned_cup_has_the_volume_of_its_profile():
    mesh = Lathe(CUP).mesh(around=512)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * (9 * 1 + (9 - 4) * 3), rel=1e-3)


def test_section_is_rectangular_below_and_round_above():
    lathe = Lathe(
        np.array([(0, 0), (1, 0), (1, 4), (0, 4)], dtype=float), SuperellipseSection(0.5, 20.0, 1.0, 3.0)
    )
    low, high = 0.5, 3.5
    points = np.array(
        [(0.9, 0.4, low), (0.1, 0.6, low), (0.9, 0.4, high), (0.1, 0.9, high), (0.0, 1.1, high)]
    )
    np.testing.assert_array_equal(lathe.inside(points), [True, False, True, True, False])
    np.testing.assert_allclose(lathe.bounds, [(-1, -1, 0), (1, 1, 4)])


def test_straight_handle_is_an_elliptic_rod():
    line = np.stack([np.linspace(0, 10, 21), np.zeros(21)], axis=1)
    rod = Handle(line, np.full(21, 1.0), np.full(21, 2.0), exponent=2.0)
    np.testing.assert_allclose(rod.half_width(np.full(3, 5.0), np.array([0.0, 0.6, 1.2])), [2.0, 1.6, 0.0])
    mesh = rod.mesh(around=256)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(np.pi * 1 * 2 * 10, rel=1e-3)
