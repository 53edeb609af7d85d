"""Choice between the resting poses of an object, and between classes in resting poses where none is known."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from perception.inference.clear_evidence import is_stubby
from perception.inference.contents import VESSELS
from perception.inference.pose_choice import (
    has_closed_top,
    is_better,
    is_doubtful,
    is_good,
    misfit,
)
from perception.inference.resting import ALTERNATIVES
from perception.inference.scored_fits import ObjectFits, RejectedError, ScoredFit
from perception.inference.screening import comes_near, nearest_hypotheses
from perception.inference.upright_choice import CLEAR
from perception.types import POSED_CLASSES, Category, RestingPose

logger = logging.getLogger(__name__)

SURE = 0.6  # probability of some classes in resting poses from which on they are fitted in any case
LIKELY = 0.15  # least probability of each of them
ABOUT = 0.05  # by how much the misfit of what the pose network is sure of may be larger
# Probability of none of the classes in any pose from which on no shape is fitted. In six scans of clutter 18
# of 48 candidates that no shape explained had more, and the 19 that one did had 0.39 at most.
SURE_OF_NONE = 0.9
UNKNOWN = 0.5  # least score of an object of no class, or in a pose that the networks were not trained on
REVERSED: Mapping[RestingPose, RestingPose] = {
    "upright": "upside-down",
    "upside-down": "upright",
    "lying": "lying",
}  # resting poses with the axis reversed


def as_named(fits: ObjectFits, or_upright: bool) -> ScoredFit | None:
    """Return the best good fit as one of the classes in resting poses that the pose network names.

    Args:
        fits: Fits the object.
        or_upright: Whether upright poses count, which other networks know better.
    """
    likely = {
        posed: p
        for posed, p in zip(POSED_CLASSES, fits.views.pose_probabilities.tolist())
        if p >= LIKELY and (or_upright or posed[1] != "upright")
    }
    if sum(likely.values()) < SURE:
        return None
    good: list[tuple[float, ScoredFit]] = []
    for (category, resting), p in likely.items():
        made = _either_way_round(fits, category, resting)
        if made is not None and is_named_well(made, fits):
            good.append((misfit(made.evidence) - ABOUT * p, made))
    return min(good, key=lambda item: item[0])[1] if good else None


def is_named_well(made: ScoredFit, fits: ObjectFits) -> bool:
    """Return whether a fit as what the pose network names is good, and its score is high enough."""
    return made.estimate.score >= _least_score(fits) and _is_good(made, fits)


def is_as_named(named: ScoredFit, other: ScoredFit | None) -> bool:
    """Return whether what the pose network names explains the depth about as well as another fit."""
    return other is None or misfit(named.evidence) < misfit(other.evidence) + ABOUT


def fit_unnamed(fits: ObjectFits) -> ScoredFit:
    """Return the fit of an object without a class that has the highest score of those at rest and good.

    Raises:
        RejectedError: There is none, its score is below ``UNKNOWN``, or the pose network is sure of none.
    """
    if fits.views.pose_probabilities.size and fits.views.pose_probabilities[-1] > SURE_OF_NONE:
        raise RejectedError(fits.views.category, 0.0, "the pose network names none of the classes")
    good: list[ScoredFit] = []
    for category, resting in nearest_hypotheses(fits.views, fits.decoder, fits.plane, fits.config):
        made = _either_way_round(fits, category, resting)
        if made is not None and _is_good(made, fits):
            good.append(made)
            if made.estimate.score > CLEAR:
                break
    best = max(good, key=lambda scored: scored.estimate.score, default=None)
    if best is None:
        raise RejectedError(fits.views.category, 0.0, "no shape in any resting pose explains the depth")
    if best.estimate.score < _least_score(fits):
        reason = fits.model.reason(best.evidence, best.estimate.category, best.probability)
        raise RejectedError(best.estimate.category, best.estimate.score, reason)
    return best


def best_pose(
    fits: ObjectFits, upright: ScoredFit | None, categories: Sequence[Category], is_given: bool
) -> ScoredFit | None:
    """Return the upright fit, or one of another class or pose that explains the depth clearly better.

    Args:
        fits: Fits the object.
        upright: Best upright fit; None if there is none.
        categories: Classes whose other poses are tried.
        is_given: Whether the class was given, so that its poses need no least score.
    """
    views, plane = fits.views, fits.plane
    closed = any(c in VESSELS for c in categories) and has_closed_top(views.observations, plane)
    if upright is not None and not closed and not is_doubtful(upright.evidence, upright.estimate.category):
        return upright
    # The coarse upright fit ignores a closed top as if it were of contents, and comes nearer than it should.
    others = [
        _either_way_round(fits, c, pose)
        for c in categories
        for pose in ALTERNATIVES[c]
        if (closed and pose == "upside-down")
        or comes_near(replace(views, category=c), fits.decoder, plane, pose, fits.config)
    ]
    before = None if upright is None else upright.evidence
    least = 0.0 if is_given else _least_score(fits)
    scored = [o for o in others if o is not None and o.estimate.score >= least]
    better = [o for o in scored if is_better(o.evidence, o.estimate, before, plane, closed)]
    if not better:
        return upright
    best = min(better, key=lambda scored: misfit(scored.evidence))
    logger.info("object %d: %s", views.id, best.estimate.resting)
    return best


def other_way_round(fits: ObjectFits, fit: ScoredFit) -> ScoredFit | None:
    """Return a fit of the same class with the axis reversed; None if there is none."""
    category, resting = fit.estimate.category, REVERSED[fit.estimate.resting]
    reversed_axis = -fit.estimate.T_world_object[:3, 2]
    first = fits.attempt(category, resting) if resting == "lying" else None
    if first is not None and first.estimate.T_world_object[:3, 2] @ reversed_axis > 0:
        return first  # of which the given one is the reverse
    x, y, z = reversed_axis.tolist()
    return fits.attempt(category, resting, (x, y, z))


def _either_way_round(fits: ObjectFits, category: Category, resting: RestingPose) -> ScoredFit | None:
    """Return a fit; of what lies and has a low score, the one the other way round if it is good and higher.

    A bottle that was fitted from its neck has none, and therefore a low score.
    """
    made = fits.attempt(category, resting)
    if made is None or resting != "lying" or made.estimate.score >= _least_score(fits):
        return made
    other = other_way_round(fits, made)
    if other is None or not _is_good(other, fits) or other.estimate.score <= made.estimate.score:
        return made
    return other


def _least_score(fits: ObjectFits) -> float:
    return max(fits.model.threshold, UNKNOWN)


def _is_good(scored: ScoredFit, fits: ObjectFits) -> bool:
    """Return whether a fit is good, and no lying bottle that is too short for one."""
    estimate = scored.estimate
    is_short = estimate.resting == "lying" and is_stubby(estimate)
    return not is_short and is_good(scored.evidence, estimate, fits.plane)
