import numpy as np
import pytest
import trimesh

from manipulation.nesting import (
    RadialProfile,
    nest_heights,
    nests,
    radial_profile,
    resting_height,
    stack_bowls,
)
from manipulation.standing import to_standing

HEIGHTS = np.arange(0.001, 0.1, 0.002)  # rim of the lower bowl at 99 mm
CONE = RadialProfile(HEIGHTS, 0.04 + 0.5 * HEIGHTS, 0.03 + 0.5 * HEIGHTS)


def cylinder(radius):
    heights = np.arange(0.001, 0.05, 0.002)
    return RadialProfile(heights, np.full(len(heights), radius), np.zeros(len(heights)))


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


@pytest.mark.parametrize("radius", [0.034, 0.050, 0.064])
def test_resting_height_is_where_the_radii_meet_with_clearance(radius):
    """outer + 0.5 mm = 0.03 + 0.5 z at the lowest ring of the cylinder, rounded up to whole millimetres."""
    exact = (radius + 0.0005 - 0.03) / 0.5 - 0.001
    lift = resting_height(cylinder(radius), CONE)
    assert exact - 1e-9 <= lift < exact + 0.001
    assert resting_height(cylinder(radius), CONE, clearance=0.0) == pytest.approx(lift - 0.001)


def test_a_bowl_wider_than_the_lower_rim_does_not_rest_inside():
    assert resting_height(cylinder(0.09), CONE) is None


def test_bowls_that_would_sit_above_70_percent_of_the_lower_height_do_not_nest():
    assert nests(cylinder(0.064), CONE) == pytest.approx(0.068)  # 69 % of 99 mm
    assert resting_height(cylinder(0.0655), CONE) == pytest.approx(0.071)  # 72 %
    assert nests(cylinder(0.0655), CONE) is None


def test_fitting_bowls_form_one_stack_from_the_largest_up(shapes):
    sizes = (0.045, 0.075, 0.060)
    bowls = items_of(shapes, *[shapes.bowl(radius, 0.75 * radius, slope=0.3) for radius in sizes])
    assert names(stack_bowls(bowls)) == [["bowl_1", "bowl_2", "bowl_0"]]
    assert names(stack_bowls(bowls[::-1])) == [["bowl_1", "bowl_2", "bowl_0"]]


def test_bowls_that_do_not_fit_into_each_other_form_separate_stacks(shapes):
    bowls = items_of(shapes, *[shapes.bowl(0.06, slope=0.0)] * 2)
    assert nests(*(radial_profile(bowl) for bowl in bowls)) is None
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
    assert nests(radial_profile(small), radial_profile(ragged)) == pytest.approx(0.005, abs=0.003)
