"""Resting lifts and nest counts of cups whose contact has a closed form."""

import numpy as np
import pytest
import trimesh

from app.task.bowl_nesting import RADIUS_STEP, RadialEnvelope, min_nests, radial_envelope, resting_lift


def cup(rim, base, height=0.06, wall=0.004, floor=0.005):
    """A conical cup with a wall of constant horizontal thickness, as a closed profile (r, z)."""
    slope = (rim - base) / height
    inner_base = base + slope * floor - wall
    profile = [(0, 0), (base, 0), (rim, height), (rim - wall, height), (inner_base, floor), (0, floor)]
    mesh = trimesh.creation.revolve(np.array(profile), sections=48)
    return radial_envelope(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def test_envelope_of_a_cylinder_with_a_step():
    profile = np.array([(0, 0), (0.02, 0), (0.02, 0.01), (0.04, 0.03), (0, 0.03)])
    mesh = trimesh.creation.revolve(profile, sections=48)
    envelope = radial_envelope(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    radius = RADIUS_STEP * np.arange(len(envelope.top))
    assert radius[-1] == pytest.approx(0.04, abs=RADIUS_STEP)
    np.testing.assert_allclose(envelope.top[1:-1], 0.03, atol=1e-6)
    inside, beyond = (radius > 0) & (radius < 0.0195), (radius > 0.0205) & (radius < 0.0395)
    np.testing.assert_allclose(envelope.bottom[inside], 0.0, atol=1e-6)
    np.testing.assert_allclose(envelope.bottom[beyond], 0.01 + (radius[beyond] - 0.02), atol=2e-4)


def test_equal_cones_rest_on_their_walls_or_on_the_floor():
    slope = (0.07 - 0.03) / 0.06
    walls = cup(0.07, 0.03, wall=0.008, floor=0.003)
    assert resting_lift(walls, walls) == pytest.approx(0.008 / slope, abs=1e-3)
    floor = cup(0.07, 0.03, wall=0.002, floor=0.01)
    assert resting_lift(floor, floor) == pytest.approx(0.01, abs=1e-3)


def test_a_cylinder_stands_on_the_floor_if_it_fits_and_on_the_rim_otherwise():
    lower = cup(0.06, 0.06)
    assert resting_lift(cup(0.05, 0.05), lower) == pytest.approx(0.005, abs=1e-6)
    assert resting_lift(cup(0.058, 0.058), lower) == pytest.approx(0.06, abs=1e-6)


def test_a_cone_hangs_on_the_rim_of_a_cylinder():
    lower, upper = cup(0.05, 0.05, height=0.06), cup(0.07, 0.03, height=0.06)
    depth = (0.05 - 0.004 - 0.03) * 0.06 / 0.04  # where the cone is as wide as the opening
    assert resting_lift(upper, lower) == pytest.approx(0.06 - depth, abs=1.5e-3)


def test_surfaces_are_interpolated_across_large_triangles():
    corners = np.array([(-0.05, -0.05, 0.0), (0.05, -0.05, 0.0), (0.05, 0.05, 0.0), (-0.05, 0.05, 0.0)])
    envelope = radial_envelope(corners, np.array([(0, 1, 2), (0, 2, 3)]))
    assert np.isfinite(envelope.top[5:]).all() and np.abs(envelope.top[5:]).max() == 0


@pytest.mark.parametrize(("max_lift", "nests"), [(0.6, 1), (0.05, 3)])
def test_nests_of_cones_that_all_fit(max_lift, nests):
    cones = [cup(rim, rim - 0.04) for rim in (0.05, 0.07, 0.06)]
    assert min_nests(cones, max_lift) == nests


def test_cylinders_of_one_size_make_a_nest_each():
    assert min_nests([cup(0.05, 0.05)] * 3, 0.6) == 3


def test_the_lift_is_compared_with_the_height_of_the_lower_bowl():
    low, tall = cup(0.07, 0.07, height=0.03, floor=0.012), cup(0.05, 0.05, height=0.09)
    assert resting_lift(tall, low) == pytest.approx(0.012, abs=1e-6)
    assert min_nests([low, tall], 0.39) == 2  # 12 of 30 mm
    assert min_nests([low, tall], 0.41) == 1


def test_nests_are_as_few_as_any_assignment_allows():
    """First fit would stack b on a and leave c and d, which fit into a and b alone, without a common nest."""

    def ring(n_radii, top, bottom):
        """A plate of height 1 whose surfaces leave T = 0 and U = 1 at the given radius indices alone."""
        envelope = RadialEnvelope(np.zeros(n_radii), np.ones(n_radii))
        for index, height in top.items():
            envelope.top[index] = height
        for index, height in bottom.items():
            envelope.bottom[index] = height
        envelope.top[-1] = 1.0
        return envelope

    a = ring(50, {}, {})
    b = ring(40, {5: 0.9}, {})
    c = ring(30, {6: 0.9}, {5: 0.1})
    d = ring(20, {}, {6: 0.1})
    fits = [
        (up, low) for up in (b, c, d) for low in (a, b, c) if low is not up and resting_lift(up, low) <= 0.6
    ]
    assert [(len(up.top), len(low.top)) for up, low in fits if len(up.top) < len(low.top)] == [
        (40, 50), (30, 50), (20, 50), (20, 40),
    ]  # fmt: skip
    assert min_nests([d, b, a, c], 0.6) == 2


def test_no_bowls_need_no_nest():
    assert min_nests([], 0.6) == 0
