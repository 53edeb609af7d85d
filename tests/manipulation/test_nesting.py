import numpy as np
import pytest
import trimesh

from manipulation.nesting import (
    RadialSurfaces,
    nest_heights,
    nests,
    radial_profile,
    radial_surfaces,
    resting_lift,
    stack_bowls,
)
from manipulation.standing import to_standing


def items_of(shapes, *meshes):
    """Standing bowls bowl_0, bowl_1, ... from meshes."""
    return [to_standing(shapes.estimate(i, "bowl", mesh)) for i, mesh in enumerate(meshes)]


def names(stacks):
    return [[bowl.name for bowl in stack] for stack in stacks]


def test_radial_profile_of_straight_walls_is_exact(shapes):
    (bowl,) = items_of(shapes, shapes.bowl(0.075, height=0.06, wall=0.004, slope=0.3))
    profile = radial_profile(bowl)
    assert profile.rim == pytest.approx(0.06, abs=0.0025)
    # The mesh is a polygon of 48 corners: up to 0.2 % inside the circle.
    outer = 0.075 - (0.06 - profile.heights) * np.tan(0.3)
    assert profile.outer == pytest.approx(outer, abs=3e-4)
    cavity = profile.heights > 0.006
    assert profile.inner[cavity] == pytest.approx(outer[cavity] - 0.004 / np.cos(0.3), abs=3e-4)
    assert not profile.inner[profile.heights < 0.004].any()


def vessel(shapes, number, rim, base, height=0.06, wall=0.004, floor=0.005, sections=48):
    """A standing bowl with straight walls of one horizontal thickness, from its profile (r, z)."""
    slope = (rim - base) / height
    inner_base = base + slope * floor - wall
    profile = [(0, 0), (base, 0), (rim, height), (rim - wall, height), (inner_base, floor), (0, floor)]
    mesh = trimesh.creation.revolve(np.array(profile), sections=sections)
    return to_standing(shapes.estimate(number, "bowl", mesh))


def lift(shapes, upper, lower):
    return resting_lift(*(radial_surfaces(vessel(shapes, i, **of)) for i, of in enumerate((upper, lower))))


@pytest.mark.parametrize(
    ("upper", "lower", "expected"),
    [
        # Alike cones rest on their walls, by their thickness over their slope, or on the floor.
        (dict(rim=0.07, base=0.03, wall=0.008, floor=0.003), None, 0.008 / (0.04 / 0.06)),
        (dict(rim=0.07, base=0.03, wall=0.002, floor=0.01), None, 0.01),
        # A cylinder stands on the floor where it fits, and on the rim otherwise.
        (dict(rim=0.05, base=0.05), dict(rim=0.06, base=0.06), 0.005),
        (dict(rim=0.058, base=0.058), dict(rim=0.06, base=0.06), 0.06),
        # A cone hangs on the rim of a cylinder where it is as wide as the opening.
        (dict(rim=0.07, base=0.03), dict(rim=0.05, base=0.05), 0.06 - 0.016 / (0.04 / 0.06)),
        # What is wider than the lower rim hangs on it with its flat base.
        (dict(rim=0.09, base=0.08), dict(rim=0.06, base=0.04), 0.06),
    ],
)
def test_resting_lift_is_that_of_the_first_contact(shapes, upper, lower, expected):
    assert lift(shapes, upper, lower or upper) == pytest.approx(expected, abs=1.5e-3)


def test_the_narrowest_side_of_a_polygon_carries_at_any_yaw(shapes):
    """Between flats, a cavity of six sides is narrower by cos(30 degrees) than across its corners."""
    round_, upper = dict(rim=0.07, base=0.05), dict(rim=0.068, base=0.03)
    on_floor, on_flats = (lift(shapes, upper, {**round_, "sections": n}) for n in (48, 6))
    assert on_floor == pytest.approx(0.005, abs=1e-3)
    slope = 0.038 / 0.06
    # The wall of the upper one meets the rim's flats from inside.
    meets = (0.066 * np.cos(np.pi / 6) - 0.03) / slope
    assert on_flats == pytest.approx(0.06 - meets, abs=2e-3)


def test_surfaces_of_a_cylinder_with_a_step(shapes):
    profile = np.array([(0, 0), (0.02, 0), (0.02, 0.01), (0.04, 0.03), (0, 0.03)])
    (item,) = items_of(shapes, trimesh.creation.revolve(profile, sections=48))
    found = radial_surfaces(item)
    radius = 0.001 * np.arange(len(found.top))
    assert 0.04 <= radius[-1] < 0.042
    within, beyond = (radius > 0.001) & (radius < 0.0195), (radius > 0.0205) & (radius < 0.0395)
    np.testing.assert_allclose(found.top[within | beyond], 0.03, atol=1e-6)
    np.testing.assert_allclose(found.bottom[within], 0.0, atol=1e-6)
    np.testing.assert_allclose(found.bottom[beyond], 0.01 + (radius[beyond] - 0.02), atol=2e-4)


def test_bowls_that_would_sit_above_70_percent_of_the_lower_height_do_not_nest():
    def of(top, bottom):
        return RadialSurfaces(np.array([top, 0.1]), np.array([bottom, 0.1]))

    assert nests(of(0.0, 0.0), of(0.069, 0.0)) == pytest.approx(0.069)
    assert nests(of(0.0, 0.0), of(0.071, 0.0)) is None


def test_fitting_bowls_form_one_stack_from_the_largest_up(shapes):
    sizes = (0.045, 0.075, 0.060)
    bowls = items_of(shapes, *[shapes.bowl(radius, 0.75 * radius, slope=0.3) for radius in sizes])
    assert names(stack_bowls(bowls)) == [["bowl_1", "bowl_2", "bowl_0"]]
    assert names(stack_bowls(bowls[::-1])) == [["bowl_1", "bowl_2", "bowl_0"]]


def test_bowls_that_do_not_fit_into_each_other_form_separate_stacks(shapes):
    bowls = items_of(shapes, *[shapes.bowl(0.06, slope=0.0)] * 2)
    assert nests(*map(radial_surfaces, bowls)) is None
    assert names(stack_bowls(bowls)) == [["bowl_0"], ["bowl_1"]]
    assert nest_heights(bowls) == pytest.approx([0.0, 0.06], abs=0.0025)  # rim on base
    assert stack_bowls([]) == []


def test_nesting_heights_follow_from_the_walls(shapes):
    large, small = items_of(shapes, shapes.bowl(0.075, slope=0.3), shapes.bowl(0.055, 0.045, slope=0.3))
    heights = nest_heights([large, small])
    assert heights[0] == 0 and heights[1] == pytest.approx(0.005, abs=0.003), "small bowl stands on the floor"
    alike = items_of(shapes, *[shapes.bowl(0.07, wall=0.004, slope=0.5)] * 3)
    # Alike bowls touch along their walls: each is up by wall / sin(slope).
    assert nest_heights(alike) == pytest.approx(np.arange(3) * 0.004 / np.sin(0.5), abs=0.005)


def test_a_ragged_rim_does_not_close_a_bowl(shapes):
    whole = shapes.bowl(0.075, slope=0.3)
    vertices = np.array(whole.vertices)
    top = vertices[:, 2] > vertices[:, 2].max() - 0.0005
    spike = top & (np.abs(np.arctan2(vertices[:, 1], vertices[:, 0])) < 0.5)
    vertices[spike, 2] += 0.003
    ragged, small = items_of(
        shapes, trimesh.Trimesh(vertices, whole.faces), shapes.bowl(0.055, 0.045, slope=0.3)
    )
    assert nests(radial_surfaces(small), radial_surfaces(ragged)) == pytest.approx(0.005, abs=0.003)
