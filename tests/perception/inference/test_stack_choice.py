"""When the fits of two parts replace that of the whole, on cylinders with given scores."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from perception.inference import stack_choice
from perception.inference.stack_choice import (
    BESIDE_SCORE,
    COAXIAL,
    DOUBTFUL,
    FULLY,
    LEAST_HEIGHT,
    LIKELY_WHOLE,
    NARROW_DOUBT,
    NARROW_SCORE,
    SHARED,
    SLENDER,
    TALL,
    UNNAMED_SCORES,
    WEAK,
    WEAK_BOTTLE,
    are_one,
    are_two,
    gap_between,
    has_unlikely_shape,
    is_doubtful,
)
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

PLANE = SupportPlane()
POINTS = np.zeros((10, 3))


def shape(
    category="can", base=0.0, height=0.1, radius=0.03, score=0.9, resting="upright", x=0.0, status="converged"
):
    cylinder = trimesh.creation.cylinder(radius, height)
    T = np.eye(4)
    T[:3, 3] = x, 0.0, base + height / 2
    mesh = TriangleMesh(np.asarray(cylinder.vertices), np.asarray(cylinder.faces))
    made = ObjectEstimate(
        1, category, np.zeros(16), T, np.ones(3), mesh, score, status=status, resting=resting
    )
    return replace(made, rests_on=1 if base > 0 else None)


CANS = [shape(), shape(base=0.1)]


@pytest.fixture
def leave(monkeypatch):
    """A function that sets the share of the points that two parts leave unexplained, also beside a cavity."""

    def set_shares(share, beside=None):
        def unexplained(points, shapes, vessel=None):
            return share if vessel is None or beside is None else beside

        monkeypatch.setattr(stack_choice, "unexplained", unexplained)

    return set_shares


def test_a_gap_is_measured_along_the_vertical():
    assert gap_between(shape(), shape(base=0.12, x=0.01), PLANE) == pytest.approx(0.02)
    assert gap_between(shape(), shape(base=0.05), PLANE) == pytest.approx(-0.05)


def test_what_leaves_points_unexplained_or_has_a_low_score_is_doubtful():
    assert is_doubtful(None, 2 * DOUBTFUL) and not is_doubtful(None, DOUBTFUL / 2)
    for whole, limit in ((shape(), WEAK), (shape("bottle"), WEAK_BOTTLE)):
        assert is_doubtful(replace(whole, score=limit - 0.01), 0.0)
        assert not is_doubtful(replace(whole, score=limit + 0.01), 0.0)
    assert not is_doubtful(shape("bottle", resting="lying", score=0.7), 0.0)


@pytest.mark.parametrize(
    ("before", "after", "scores", "are_better"),
    [
        (0.2, 0.09, (0.3, 0.6), True),
        (0.2, 0.11, (0.3, 0.6), False),  # more than half of it remains, and more than a tenth of all
        (0.4, 0.11, (0.3, 0.6), False),
        (0.2, 0.09, (0.1, 0.6), False),
        (0.2, 0.09, (0.3, 0.4), False),
        (0.2, 0.02, (0.15, 0.15), True),  # beyond doubt
        (0.2, 0.02, (0.15, 0.05), False),
    ],
)
def test_parts_explain_clearly_more_and_have_scores(leave, before, after, scores, are_better):
    leave(after)
    pair = [replace(part, score=score) for part, score in zip(CANS, scores)]
    assert are_two(pair, shape("mug", score=0.95), POINTS, before, PLANE) is are_better
    sure = all(score >= least for score, least in zip(scores, UNNAMED_SCORES))
    assert are_two(pair, None, POINTS, before, PLANE) is (are_better and sure), "of no class"


@pytest.mark.parametrize(
    ("part", "accepted"),
    [
        (shape(base=0.1, height=LEAST_HEIGHT - 0.002), False),
        (shape(base=0.1, height=LEAST_HEIGHT + 0.002), True),
        (replace(CANS[1], status="implausible"), False),
        (shape("bottle", base=0.1, height=0.06 * SLENDER - 0.002), False),
        (shape("bottle", base=0.1, height=0.06 * SLENDER + 0.002), True),
    ],
)
def test_discs_knobs_and_what_is_implausible_are_no_parts(leave, part, accepted):
    leave(0.0)
    assert are_two([CANS[0], part], None, POINTS, 1.0, PLANE) is accepted
    assert not are_two([shape("bottle", resting="lying"), part], None, POINTS, 1.0, PLANE), "it may roll"


@pytest.mark.parametrize(
    ("scores", "accepted"),
    [
        ((BESIDE_SCORE + 0.01, BESIDE_SCORE + 0.01), True),
        ((BESIDE_SCORE - 0.01, 0.9), False),
        ((0.9, BESIDE_SCORE - 0.01), False),
    ],
)
def test_parts_beside_each_other_hide_nothing_that_excuses_low_scores(leave, scores, accepted):
    leave(0.0)
    beside = [shape(), shape(x=0.07)]
    pair = [replace(part, score=score) for part, score in zip(beside, scores)]
    assert are_two(pair, None, POINTS, 1.0, PLANE) is accepted


@pytest.mark.parametrize(
    ("whole", "are_better"),
    [
        ({"score": LIKELY_WHOLE + 0.01}, False),
        ({"score": LIKELY_WHOLE - 0.01}, True),
        ({"score": LIKELY_WHOLE + 0.01, "status": "implausible"}, True),
        ({"score": LIKELY_WHOLE + 0.01, "category": "mug"}, True),
    ],
)
def test_a_likely_object_is_not_replaced_by_an_unlikely_part(leave, whole, are_better):
    """A tall can is no mug, hardly seen, below a can."""
    leave(0.02)
    single = shape(height=0.2, **whole)
    unlikely = [replace(CANS[0], score=BESIDE_SCORE - 0.1), CANS[1]]
    assert are_two(unlikely, single, POINTS, 0.1, PLANE) is are_better
    assert are_two(CANS, single, POINTS, 0.1, PLANE)


@pytest.mark.parametrize(("score", "accepted"), [(0.7, True), (0.6, False)])
def test_likely_parts_replace_what_is_taken_for_a_thing(leave, score, accepted):
    """They need not explain clearly more than its shape does."""
    leave(0.05)
    pair = [CANS[0], replace(CANS[1], score=score)]
    assert are_two(pair, shape(score=0.2), POINTS, 0.08, PLANE, is_left_out=True) is accepted
    assert not are_two(pair, shape(score=0.2), POINTS, 0.08, PLANE)
    leave(0.02)
    assert are_two(pair, shape(score=0.2), POINTS, 0.08, PLANE, is_left_out=True), "they explain more"
    leave(0.2)
    assert not are_two(CANS, shape(score=0.2), POINTS, 0.3, PLANE, is_left_out=True)


@pytest.mark.parametrize(("sunk", "accepted"), [(0.6, True), (1.6, False)])
def test_one_object_does_not_pass_through_another(leave, sunk, accepted):
    leave(0.0)
    upper = shape(base=0.1 - sunk * SHARED * 0.1)
    assert are_two([shape(), upper], None, POINTS, 1.0, PLANE) is accepted


def test_far_better_scores_replace_an_unusual_shape_that_explains_as_much(leave):
    leave(0.02)
    for score, accepted in ((0.45, True), (0.49, False), (0.55, False)):
        pair = [replace(CANS[0], score=0.78), CANS[1]]
        assert are_two(pair, shape("bowl", radius=0.1, score=score), POINTS, 0.02, PLANE) is accepted


@pytest.mark.parametrize(
    ("whole", "is_unlikely"),
    [
        (shape("bowl", height=0.08 * TALL + 0.002, radius=0.08), True),
        (shape("bowl", height=0.08 * TALL - 0.002, radius=0.08), False),
        (shape("bowl", height=0.16, radius=0.08, resting="lying"), False),
        (shape("mug", height=0.10, radius=0.04), False),
        (shape("mug", height=0.10, radius=0.04, status="implausible"), True),
    ],
)
def test_parts_that_explain_all_replace_a_bowl_on_a_high_foot(leave, whole, is_unlikely):
    """A bowl on a can whose pixels are in its masks, or in none, explains what is measured."""
    leave(0.0)
    pair = [shape(score=0.3), shape("bowl", base=0.1, height=0.06, radius=0.07)]
    assert has_unlikely_shape(whole) is is_doubtful(whole, 0.0) is is_unlikely
    assert are_two(pair, whole, POINTS, 0.0, PLANE) is is_unlikely
    assert not are_two([replace(pair[0], score=0.1), pair[1]], whole, POINTS, 0.0, PLANE)
    leave(2 * DOUBTFUL)
    assert not are_two(pair, whole, POINTS, 0.0, PLANE)


@pytest.mark.parametrize(
    ("upper", "beside", "accepted"),
    [
        (shape("bowl", base=0.1, radius=0.07), 0.02, True),
        (shape("bowl", base=0.1, radius=0.07), 2 * DOUBTFUL, False),
        (shape(base=0.1), 0.02, False),
    ],
)
@pytest.mark.parametrize(
    "whole", [shape(score=0.23), shape("bowl", height=0.13, radius=0.074, status="implausible")]
)
def test_the_floor_of_a_vessel_may_be_thicker_than_its_shapes(leave, upper, beside, accepted, whole):
    """Where the parts have far better scores, or the whole is far from its class."""
    leave(0.3, beside)
    assert are_two([shape(), upper], whole, POINTS, 0.08, PLANE) is accepted


@pytest.mark.parametrize(("score", "accepted"), [(0.7, True), (0.8, False), (0.95, False)])
@pytest.mark.parametrize("after", [0.02, 0.001])
def test_a_bottle_of_low_score_may_be_two_cans_with_better_ones(leave, score, accepted, after):
    """Where it explains all that is seen, it does not matter that they explain a little more."""
    leave(after)
    pair = [replace(CANS[0], score=0.75), CANS[1]]
    whole = shape("bottle", height=0.2, score=score)
    assert are_two(pair, whole, POINTS, 0.02, PLANE) is accepted
    assert not are_two([pair[0], replace(pair[1], category="bowl")], whole, POINTS, 0.02, PLANE)


def test_two_cans_on_one_axis_are_the_bottle_that_explains_all():
    whole = shape("bottle", height=0.2, score=0.2)
    assert are_one(CANS, whole, FULLY / 2)
    assert not are_one(CANS, whole, 2 * FULLY)
    assert not are_one(CANS, replace(whole, resting="lying"), 0.0)
    assert not are_one(CANS, replace(whole, category="can"), 0.0)
    for upper in (
        shape(base=0.1, x=COAXIAL + 1e-3),
        shape("bowl", base=0.1),
        shape(base=0.1, radius=0.034),  # no bottle widens upwards
        shape(base=0.1, score=0.4),
    ):
        assert not are_one([CANS[0], upper], whole, 0.0)


@pytest.mark.parametrize(("base", "is_one"), [(0.03, True), (0.034, False)])
def test_a_can_that_widens_upwards_is_one_where_its_halves_have_the_same_radius(base, is_one):
    """Not what their largest radii are tells, but those where they meet."""

    def widening(estimate, low, high):
        v = estimate.mesh.vertices.copy()
        share = (v[:, 2] - v[:, 2].min()) / np.ptp(v[:, 2])
        v[:, :2] *= ((low + share * (high - low)) / estimate.radius)[:, None]
        return replace(estimate, mesh=TriangleMesh(v, estimate.mesh.faces))

    def rings(estimate):
        mesh = trimesh.creation.cylinder(estimate.radius, estimate.height).subdivide().subdivide()
        return replace(estimate, mesh=TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)))

    lower, upper = (rings(e) for e in CANS)
    pair = [widening(lower, 0.025, 0.03), widening(upper, base, base + 0.006)]
    assert pair[1].radius > 1.15 * pair[0].radius
    assert are_one(pair, shape("bottle", height=0.2, score=0.4), 0.0) is is_one


@pytest.mark.parametrize(
    ("upper", "accepted"),
    [
        (shape("bowl", base=0.06, height=0.04), True),
        (shape("bowl", base=0.028, height=0.04), False),  # the floor of a mug of two colours
        (shape("bowl", base=0.04, height=0.1), False),
        (shape("can", base=0.06, height=0.04), False),
        (shape("bowl", base=0.06, height=0.04, score=0.75), False),
    ],
)
def test_a_vessel_that_explains_all_may_be_two(leave, upper, accepted):
    leave(0.01)
    lower, whole = shape("mug", height=0.08, score=0.95), shape("mug", score=0.97)
    assert are_two([lower, upper], whole, POINTS, 0.0, PLANE) is accepted
    leave(2 * DOUBTFUL)
    assert not are_two([lower, upper], whole, POINTS, 0.0, PLANE)


@pytest.mark.parametrize(
    ("lower", "upper", "accepted"),
    [
        ({}, {}, True),
        ({"radius": 0.046}, {}, False),  # the lower part of a mug of two colours is as wide as the upper one
        ({"score": 0.6}, {}, False),
        ({"category": "mug"}, {}, False),
        ({}, {"score": 0.94}, False),  # one mug is as likely
        ({}, {"base": 0.005}, False),
        ({}, {"category": "bowl"}, False),
    ],
)
def test_a_mug_that_explains_all_may_be_one_in_a_shallow_bowl(leave, lower, upper, accepted):
    leave(0.01)
    bowl = {"category": "bowl", "height": 0.05, "radius": 0.054, "score": 0.78} | lower
    mug = {"category": "mug", "base": 0.028, "height": 0.12, "radius": 0.045, "score": 0.99} | upper
    whole = shape("mug", height=0.148, radius=0.05, score=0.91)
    assert are_two([shape(**bowl), shape(**mug)], whole, POINTS, 0.0, PLANE) is accepted


@pytest.mark.parametrize(
    ("before", "after", "scores", "accepted"),
    [
        (NARROW_DOUBT + 0.004, 0.002, (NARROW_SCORE + 0.01, 0.95), True),
        (NARROW_DOUBT + 0.004, 0.002, (NARROW_SCORE - 0.01, 0.95), False),
        (NARROW_DOUBT + 0.004, 0.002, (NARROW_SCORE + 0.01, 0.93), False),
        (NARROW_DOUBT + 0.004, 0.009, (NARROW_SCORE + 0.01, 0.95), False),
        (NARROW_DOUBT - 0.002, 0.002, (NARROW_SCORE + 0.01, 0.95), False),
    ],
)
def test_a_mug_may_be_one_in_a_bowl_hardly_broader_if_both_explain_more(
    leave, before, after, scores, accepted
):
    leave(after)
    bowl = shape("bowl", height=0.048, radius=0.056, score=scores[0])
    mug = shape("mug", base=0.022, height=0.115, radius=0.049, score=scores[1])
    whole = shape("mug", height=0.13, radius=0.048, score=0.94)
    assert are_two([bowl, mug], whole, POINTS, before, PLANE) is accepted
    assert not are_two([replace(bowl, category="mug"), mug], whole, POINTS, before, PLANE)
