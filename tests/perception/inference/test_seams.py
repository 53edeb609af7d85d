"""Seams in outlines of known shape, and which measured points are above them."""

import numpy as np
import pytest

from perception.inference.seams import SLICE, Outline, Seam, find_seams, part_masks, seams_of
from perception.types import SupportPlane

PLANE = SupportPlane()
AWAY = np.array([1.0, 0.0])  # a camera beside the object, so far away that it looks at it from the side


def outline(*corners):
    """An outline through corners (radius, height), in centimetres."""
    radius, height = np.array(corners).T / 100
    at = np.arange(SLICE / 2, height[-1], SLICE)
    return Outline(at, np.zeros((len(at), 2)), np.interp(at, height, radius))


@pytest.mark.parametrize(
    "corners",
    [
        [(3, 0), (3, 12)],  # can
        [(3, 0), (4, 5), (3, 10)],  # barrel
        [(3, 0), (7, 6)],  # bowl
    ],
)
def test_convex_outlines_have_no_seam(corners):
    assert seams_of(outline(*corners)) == []


def test_a_waist_and_a_step_outwards_are_seams():
    for corners in (
        [(3, 0), (3, 8), (7, 12)],
        [(4, 0), (2.5, 8), (4, 16)],
        [(3, 0), (3, 8), (4, 8.2), (4, 16)],
    ):
        (seam, *_) = seams_of(outline(*corners))
        assert not seam.nested and seam.height == pytest.approx(0.08, abs=0.005)


def test_the_rim_around_something_is_a_nested_seam():
    (seam, *_) = seams_of(outline((4, 0), (7, 5), (3.5, 5.4), (3.5, 12)))
    assert seam.nested and seam.height == pytest.approx(0.052, abs=0.005)
    assert seam.below[2] > 0.06 and seam.above[2] == pytest.approx(0.035, abs=0.002)


def test_the_upper_end_of_an_object_is_no_seam():
    assert seams_of(outline((3, 0), (3, 11.5), (1, 12))) == []


def test_sections_of_a_cylinder_are_circles_about_its_axis():
    rng = np.random.default_rng(0)
    turn, height = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(0, 0.1, 20_000)
    plan = 0.03 * np.stack([np.cos(turn), np.sin(turn)], axis=1) + (0.4, -0.2)
    found = Outline.of(plan, height)
    assert found.radius == pytest.approx(np.full(len(found.height), 0.03), abs=1e-4)
    assert np.allclose(found.centre, (0.4, -0.2), atol=1e-4)
    gap = (height < 0.04) | (height > 0.06)
    assert np.allclose(Outline.of(plan[gap], height[gap]).radius, 0.03, atol=1e-4), "hidden sections"
    assert len(Outline.of(plan[:0], height[:0]).height) == 0


def test_points_over_a_seam_are_of_the_upper_object():
    seam = Seam(0.05, False, (0.0, 0.0, 0.03), (0.0, 0.0, 0.04), 0.01)
    side = np.array([[0.03, 0.0], [0.03, 0.0]])
    assert seam.is_above(side, np.array([0.049, 0.051]), AWAY, 0.06).tolist() == [False, True]


def test_the_floor_of_a_bowl_that_sinks_into_a_mug_is_of_the_bowl():
    """Seen from above, inside the mug's rim; the mug's side is seen from outside."""
    seam = Seam(0.1, False, (0.0, 0.0, 0.04), (0.0, 0.0, 0.045), 0.01)
    plan, height = np.array([[0.0, 0.0], [0.04, 0.0]]), np.array([0.09, 0.09])
    assert seam.is_above(plan, height, np.array([0.2, 0.0]), 0.4).tolist() == [True, False]


def test_what_stands_in_a_bowl_is_seen_through_its_opening():
    """A mug of radius 3 cm in a bowl of radius 7 cm, whose foot is narrower than the mug."""
    seam = Seam(0.05, True, (0.0, 0.0, 0.07), (0.0, 0.0, 0.03), 0.04)
    plan = np.array([[0.03, 0.0], [0.06, 0.0], [0.031, 0.0], [0.07, 0.0], [0.03, 0.0]])
    height = np.array([0.10, 0.03, 0.03, 0.053, 0.01])
    what = ["mug", "inside of the bowl", "mug below the rim", "rim", "foot of the bowl"]
    above = dict(zip(what, seam.is_above(plan, height, np.array([0.25, 0.0]), 0.4)))
    assert not above.pop("inside of the bowl") and not above.pop("rim")
    from_aside = seam.is_above(plan, height, AWAY, 0.06)
    assert dict(zip(what, from_aside))["foot of the bowl"] == np.False_
    above.pop("foot of the bowl")
    assert all(above.values())


def test_a_rendered_stack_is_cut_where_its_parts_touch(stack):
    seen, upper, top = stack.seen, stack.upper, stack.height
    (seam, *_) = find_seams(seen, PLANE)
    assert not seam.nested and seam.height == pytest.approx(top, abs=0.006)
    for view, true in zip(seen, upper):
        low, high = part_masks(view, seam, PLANE)
        assert not (low & high).any() and ((low | high) <= view.mask).all()
        assert (high & true).sum() > 0.95 * true.sum() and (high & ~true).sum() < 0.1 * true.sum()
