"""Which classes in resting poses are fitted, and which is kept, for given evidence."""

from dataclasses import fields, replace

import numpy as np
import pytest

from perception.inference import pose_choice, resting_choice
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.resting_choice import (
    SURE_OF_NONE,
    UNKNOWN,
    as_named,
    best_pose,
    fit_unnamed,
    is_as_named,
    other_way_round,
)
from perception.inference.scored_fits import ObjectFits, RejectedError, ScoredFit
from perception.types import POSED_CLASSES, ObjectEstimate, SupportPlane, TriangleMesh

EVIDENCE = replace(
    Evidence(*[0.5] * len(fields(Evidence))), explained=1.0, free_space=0.0, residual=1.0, converged=1.0
)
LYING, STANDING, OVER = ("bottle", "lying"), ("bottle", "upright"), ("mug", "upside-down")


def scored(posed, score=0.8, explained=0.95) -> ScoredFit:
    mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
    estimate = ObjectEstimate(3, posed[0], np.zeros(16), np.eye(4), np.ones(3), mesh, score, resting=posed[1])
    return ScoredFit(estimate, replace(EVIDENCE, explained=explained), None)


class Model(AcceptanceModel):
    def reason(self, evidence, category, class_probability=None, count=2):
        return "it floats"


@pytest.fixture
def make_fits(make_table, decoder, monkeypatch):
    """Makes fits from the fit as each class in each pose, and the probabilities of the pose network."""
    monkeypatch.setattr(pose_choice, "rests_stably", lambda mesh, plane: True)
    monkeypatch.setattr(resting_choice, "comes_near", lambda *_: True)
    monkeypatch.setattr(resting_choice, "is_stubby", lambda _: False)
    monkeypatch.setattr(resting_choice, "has_closed_top", lambda *_: False)
    table = make_table("can", (1.0, 0.5), yaw=0.0)

    def make(made, named=(), reversed_fits=()):
        monkeypatch.setattr(resting_choice, "nearest_hypotheses", lambda *_: list(made))

        def attempt(self, category, resting="upright", toward=None, depth_sigma=None):
            return (made if toward is None else dict(reversed_fits)).get((category, resting))

        monkeypatch.setattr(ObjectFits, "attempt", attempt)
        p = np.array([dict(named).get(posed, 0.0) for posed in POSED_CLASSES] + [0.0])
        views = ObjectViews(3, "bottle", 0.9, tuple(table.observations((0.0,))), np.zeros(0), p)
        return ObjectFits(views, decoder, SupportPlane(), Model({}, 0.4), FitConfig())

    return make


def test_several_named_poses_are_sure_together(make_fits) -> None:
    made = {LYING: scored(LYING), OVER: scored(OVER, explained=0.96)}
    assert as_named(make_fits(made, {LYING: 0.4, OVER: 0.15}), True) is None  # 0.55
    assert as_named(make_fits(made, {LYING: 0.4, OVER: 0.3}), True) is made[OVER]
    assert as_named(make_fits(made, {LYING: 0.7, OVER: 0.3}), True) is made[LYING]  # more probable


@pytest.mark.parametrize("poor", [scored(LYING, score=UNKNOWN - 0.1), scored(LYING, explained=0.8)])
def test_a_named_pose_must_have_its_score_and_explain_the_depth(make_fits, poor) -> None:
    assert as_named(make_fits({LYING: poor}, {LYING: 1.0}), True) is None


def test_upright_poses_count_where_asked(make_fits) -> None:
    made = {STANDING: scored(STANDING)}
    assert as_named(make_fits(made, {STANDING: 1.0}), or_upright=False) is None
    assert as_named(make_fits(made, {STANDING: 1.0}), or_upright=True) is made[STANDING]


def test_what_is_named_may_explain_a_little_less() -> None:
    assert is_as_named(scored(LYING, explained=0.9), None)
    assert is_as_named(scored(LYING, explained=0.9), scored(STANDING, explained=0.94))
    assert not is_as_named(scored(LYING, explained=0.9), scored(STANDING, explained=0.96))


def test_of_no_class_the_highest_score_counts_if_it_is_high_enough(make_fits) -> None:
    low, high = scored(LYING, 0.6), scored(OVER, 0.7)
    assert fit_unnamed(make_fits({LYING: low, OVER: high})) is high
    sure = scored(LYING, 0.95)
    assert fit_unnamed(make_fits({LYING: sure, OVER: scored(OVER, 0.99)})) is sure  # the nearest one
    with pytest.raises(RejectedError, match=r"score 0\.30: it floats"):
        fit_unnamed(make_fits({LYING: scored(LYING, 0.3)}))
    with pytest.raises(RejectedError, match="no shape in any resting pose"):
        fit_unnamed(make_fits({LYING: scored(LYING, 0.9, explained=0.5)}))


@pytest.mark.parametrize("none", [SURE_OF_NONE - 0.01, SURE_OF_NONE + 0.01])
def test_nothing_is_fitted_where_the_pose_network_is_sure_of_none(make_fits, none) -> None:
    fits = make_fits({LYING: scored(LYING)})
    p = np.append(np.full(len(POSED_CLASSES), (1 - none) / len(POSED_CLASSES)), none)
    fits = replace(fits, views=replace(fits.views, pose_probabilities=p))
    if none < SURE_OF_NONE:
        assert fit_unnamed(fits).estimate.resting == "lying"
    else:
        with pytest.raises(RejectedError, match="names none"):
            fit_unnamed(fits)


@pytest.mark.parametrize(
    ("first", "other", "is_turned"),
    [
        (scored(LYING, 0.2), scored(LYING, 0.7), True),
        (scored(LYING, 0.2, explained=0.8), scored(LYING, 0.7), True),
        (scored(LYING, 0.2), scored(LYING, 0.7, explained=0.8), False),
        (scored(LYING, 0.55), scored(LYING, 0.7), False),
        (scored(LYING, 0.2), None, False),
    ],
)
def test_what_lies_and_has_a_low_score_is_fitted_the_other_way_round(make_fits, first, other, is_turned):
    """A bottle that was fitted from its neck is hardly one."""
    fits = make_fits({LYING: first}, {LYING: 1.0}, {LYING: other})
    low = first.estimate.score < UNKNOWN
    assert as_named(fits, True) is (other if is_turned else None if low else first)
    if is_turned or not low:
        assert fit_unnamed(fits) is (other if is_turned else first)
    upright = scored(STANDING, explained=0.6)
    kept = other if is_turned else upright if low else first
    assert best_pose(fits, upright, ["bottle"], is_given=False) is kept


def test_the_reverse_of_a_reversed_fit_is_the_first_one(make_fits):
    """It is not made again, toward the opposite of the axis that the other one came to."""
    first, other = scored(LYING), scored(LYING)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    other = replace(other, estimate=replace(other.estimate, T_world_object=T))
    fits = make_fits({LYING: first}, reversed_fits={LYING: other})
    assert other_way_round(fits, first) is other
    assert other_way_round(fits, other) is first


def test_a_lying_bottle_that_is_too_short_for_one_is_none(make_fits, monkeypatch):
    """A lying mug resembles it."""
    can = ("can", "lying")
    made = {LYING: scored(LYING, 0.9), can: scored(can, 0.8, explained=0.9)}
    assert as_named(make_fits(made, {LYING: 0.6, can: 0.4}), True) is made[LYING]
    monkeypatch.setattr(resting_choice, "is_stubby", lambda estimate: estimate.category == "bottle")
    assert as_named(make_fits(made, {LYING: 0.6, can: 0.4}), True) is made[can]
    assert fit_unnamed(make_fits(made)) is made[can]
    standing = {STANDING: scored(STANDING)}
    assert fit_unnamed(make_fits(standing)) is standing[STANDING], "of lying bottles alone"


def test_another_pose_needs_a_score_unless_the_class_is_given(make_fits) -> None:
    upright, lying = scored(STANDING, explained=0.6), scored(LYING, score=0.3)
    fits = make_fits({LYING: lying})
    assert best_pose(fits, upright, ["bottle"], is_given=True) is lying
    assert best_pose(fits, upright, ["bottle"], is_given=False) is upright
    good = scored(STANDING, explained=0.95)
    assert best_pose(fits, good, ["bottle"], is_given=True) is good
    assert best_pose(make_fits({}), None, ["bottle"], is_given=True) is None


def test_a_closed_top_is_tried_upside_down_whatever_the_coarse_fit_says(make_fits, monkeypatch) -> None:
    """That of an upright mug ignores the top."""
    upright, over = scored(("mug", "upright"), explained=0.85), scored(OVER)
    fits = make_fits({OVER: over, ("mug", "lying"): scored(("mug", "lying"), explained=0.99)})
    monkeypatch.setattr(resting_choice, "comes_near", lambda *_: False)
    assert best_pose(fits, upright, ["mug"], is_given=True) is upright
    monkeypatch.setattr(resting_choice, "has_closed_top", lambda *_: True)
    assert best_pose(fits, upright, ["mug"], is_given=True) is over
