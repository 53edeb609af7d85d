"""Order of execution and cached footprints of a packing problem."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.footprints import footprint
from manipulation.packing_problem import placed_later


def test_bowls_come_first_from_the_largest_then_the_others_by_height(shapes, problem_of):
    problem = problem_of(
        ("bottle", shapes.bottle()),
        ("bowl", shapes.bowl(radius=0.06, height=0.045)),
        ("can", shapes.can(height=0.06)),
        ("bowl", shapes.bowl(radius=0.075)),
    )
    assert problem.order == ["bowl_3", "bowl_1", "can_2", "bottle_0"]
    assert problem.nested == {"bowl_1"}


def test_what_others_rest_on_comes_last(shapes, problem_of):
    kinds = ("bottle", shapes.bottle()), ("bowl", shapes.bowl(radius=0.075)), ("can", shapes.can(height=0.06))
    problem = problem_of(*kinds)
    assert problem.order == ["bowl_1", "can_2", "bottle_0"]
    assert replace(problem, later=frozenset({"bowl_1"})).order == ["can_2", "bottle_0", "bowl_1"]


@pytest.mark.parametrize(
    ("resting", "later"),
    [
        ({"can": "bowl"}, {"bowl", "inner"}),  # the inner bowl goes into it
        ({"inner": "bowl"}, set()),  # so it does in the box
        ({"can": "inner"}, {"inner"}),
        ({"can": "thing"}, set()),  # which has no goal
        ({"thing": "bowl"}, set()),
    ],
)
def test_what_others_rest_on_is_placed_later_with_the_bowls_that_go_into_it(resting, later):
    assert placed_later(resting, {"can": (), "bowl": (), "inner": ("bowl",)}) == later


def test_footprints_and_stencils_are_computed_once_per_yaw_and_gap(shapes, problem_of):
    problem = problem_of(("mug", shapes.mug()))
    cache, mug = problem.shapes, problem.items["mug_0"]
    rotated = cache.rotated("mug_0", 0.5)
    for found, expected in zip(rotated.outlines, footprint(mug).rotated(0.5).outlines, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert cache.rotated("mug_0", 0.5) is rotated and cache.rotated("mug_0", 0.6) is not rotated
    stencil = cache.stencil("mug_0", 0.5, 0.01)
    assert cache.stencil("mug_0", 0.5, 0.01) is stencil
    assert cache.stencil("mug_0", 0.5, 0.02) is not stencil
    assert cache.stencil("mug_0", 0.6, 0.01) is not stencil


def test_widths_are_the_larger_horizontal_extents(shapes, problem_of):
    problem = problem_of(("bottle", shapes.flat_bottle(0.05, 0.09)), ("can", shapes.can(0.03)))
    assert problem.shapes.width("bottle_0") == pytest.approx(0.09, abs=1e-3)
    assert problem.shapes.width("can_1") == pytest.approx(0.06, abs=1e-3)
