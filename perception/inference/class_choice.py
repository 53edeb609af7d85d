"""Choice between the classes and resting poses of an object, and none, by the evidence of its fits.

An object that the detector is sure of is fitted once. Where the class is uncertain, or the evidence
contradicts it, the next classes are fitted as well, and the one with the highest score is kept. Where its fit
as an upright object is poor, the other resting poses of the class are tried. An object without a class is
fitted as those classes in those resting poses that come near its depth in a few coarse iterations. In clutter
a network names class and resting pose: what it is sure of is kept if it explains the depth about as well.
A can, or a lying bottle, that was fitted with the wrong end up is fitted again the other way round.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace

from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import OnStep
from perception.inference.pose_choice import is_much_closer, misfit
from perception.inference.resting_choice import (
    LIKELY,
    as_named,
    best_pose,
    fit_unnamed,
    is_as_named,
    is_named_well,
)
from perception.inference.right_way_up import is_turned_over, turned_over
from perception.inference.scored_fits import ObjectFits, RejectedError, ScoredFit
from perception.inference.shape_model import Decoder
from perception.inference.upright_choice import CLEAR, best_upright, in_poor_depth, likely_classes
from perception.types import CATEGORIES, Category, ObjectEstimate, RestingPose, SupportPlane

logger = logging.getLogger(__name__)

CLOSER = 0.8  # ratio of the residuals from which on the depth tells which way round a bottle lies
# Area of a section near the top, relative to the largest one, from which on a bottle has hardly a neck. Of 28
# lying bottles in 19 scans two had more either way round: the two that were kept the wrong way round.
NO_NECK = 0.65
ALIKE = 0.02  # difference of the misfits up to which a bottle may lie either way round
REVERSED: Mapping[RestingPose, RestingPose] = {
    "upright": "upside-down",
    "upside-down": "upright",
    "lying": "lying",
}  # resting poses with the axis reversed


def fit_best_class(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    model: AcceptanceModel,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
) -> ObjectEstimate:
    """Reconstruct one object as the class with the best evidence; its score is the probability of that class.

    A class given without class probabilities is kept, and its object is never rejected. Nor is an object with
    a class that several views have confirmed: the model is fitted on single views.

    Args:
        views: Observations of the object with its most probable class and its class probabilities.
        decoder: Shape prior.
        plane: Support plane of the object.
        model: Scores the evidence.
        config: Settings of the fits.
        on_step: Called with the progress of the fit as the first class.

    Raises:
        RejectedError: The object is seen once, or of no class, and its best score is below the threshold.
        PerceptionError: No class can be fitted.
    """
    fits = ObjectFits(views, decoder, plane, model, config)
    named = as_named(fits, or_upright=views.is_unclassified)
    if views.is_unclassified:
        return _right_way_up(fits, named or fit_unnamed(fits)).estimate
    best = _best_of_classes(fits, named, on_step)
    estimate = best.estimate
    if estimate.category != views.category:
        logger.info("object %d: evidence for %s, not %s", views.id, estimate.category, views.category)
    return estimate


def _best_of_classes(fits: ObjectFits, named: ScoredFit | None, on_step: OnStep | None) -> ScoredFit:
    """Return the best fit of an object of known or uncertain class.

    Args:
        fits: Fits the object.
        named: Good fit as what the pose network names; None if there is none.
        on_step: Called with the progress of the fit as the first class.
    """
    views, model = fits.views, fits.model
    problem: PerceptionError | None = None
    try:
        first = fits.fit(views.category, on_step=on_step)
    except PerceptionError as error:
        first, problem = None, error
    if not views.class_probabilities.size:
        best = best_pose(fits, first, (views.category,), is_given=True)
    else:
        likely = likely_classes(views.class_probabilities)
        upright = best_upright(fits, first, [c for c in likely if c != views.category])
        posed = likely if upright is None else (upright.estimate.category,)
        best = best_pose(fits, upright, posed, is_given=False)
        if named is not None and is_as_named(named, best):
            best = named
    if best is None:
        assert problem is not None
        raise problem
    best = _right_way_up(fits, best)
    if _may_be_rejected(views) and best.estimate.score < fits.threshold:
        usual = in_poor_depth(fits)
        if usual is not None and usual.estimate.score >= fits.threshold:
            return usual
        reason = model.reason(best.evidence, best.estimate.category, best.probability)
        raise RejectedError(best.estimate.category, best.estimate.score, reason)
    return best


def _may_be_rejected(views: ObjectViews) -> bool:
    return views.class_probabilities.size > 0 and len(views.observations) <= 1


def _right_way_up(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit, or one the other way round: of what lies, or has its lower end up."""
    posed = (best.estimate.category, best.estimate.resting)
    if posed == ("bottle", "lying"):
        return _lying_bottle(fits, best)
    if posed == ("can", "lying"):
        return _lying_can(fits, best)
    if not _has_lower_end_up(fits, best):
        return best
    other = _other_way_round(fits, best)
    return best if other is None else _turned_over(best, other)


def _lying_bottle(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of a lying bottle, or the one the other way round."""
    other = _other_way_round(fits, best)
    if other is None:
        return best
    if _is_right_way_up(other, best):
        best, other = other, best
    alike = misfit(other.evidence) < misfit(best.evidence) + ALIKE
    if not alike or not is_turned_over(best.estimate, fits.views.observations):
        return best
    return _turned_over(best, other)


def _lying_can(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of a lying can, either way round, or that of a bottle which contradicts it.

    A bottle that is narrower at its base is often named a can, whose sides do not widen upwards.
    """
    can = _can_by_its_ends(fits, best)
    bottle = fits.attempt("bottle", "lying") if fits.pose_probability("bottle", "lying") >= LIKELY else None
    if bottle is None or not is_named_well(bottle, fits) or not _contradicts(bottle, can):
        return can
    return _lying_bottle(fits, bottle)


def _can_by_its_ends(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of a lying can, or the one the other way round: by the depth, else by its sides."""
    other = _other_way_round(fits, best)
    if other is None or is_much_closer(best.evidence, other.evidence):
        return best
    if is_much_closer(other.evidence, best.evidence):
        return other
    return _turned_over(best, other) if _has_lower_end_up(fits, best) else best


def _contradicts(bottle: ScoredFit, can: ScoredFit) -> bool:
    """Return whether a lying bottle explains the depth much better than a can the other way round.

    Sides alone hardly tell the ends of a can apart: as a bottle the same object may.
    """
    along = bottle.estimate.T_world_object[:3, 2] @ can.estimate.T_world_object[:3, 2]
    return bool(along < 0 and is_much_closer(bottle.evidence, can.evidence))


def _other_way_round(fits: ObjectFits, fit: ScoredFit) -> ScoredFit | None:
    """Return a fit of the same class with the axis reversed; None if there is none."""
    x, y, z = (-fit.estimate.T_world_object[:3, 2]).tolist()
    return fits.attempt(fit.estimate.category, REVERSED[fit.estimate.resting], (x, y, z))


def _turned_over(best: ScoredFit, other: ScoredFit) -> ScoredFit:
    """Return a fit with its axis reversed, given one that was made that way round."""
    return replace(other, estimate=turned_over(best.estimate, other.estimate))


def _has_lower_end_up(fits: ObjectFits, best: ScoredFit) -> bool:
    """Return whether a can has its lower end up by its sides.

    What may well be a bottle has not if it lies, and has to widen more if it stands.
    """
    resting = best.estimate.resting
    may_be_bottle = fits.pose_probability("bottle", resting) > fits.pose_probability("can", resting)
    is_doubtful = may_be_bottle and not _is_sure_of(fits.views, "can")
    if is_doubtful and resting == "lying":
        return False
    return is_turned_over(best.estimate, fits.views.observations, is_doubtful)


def _is_sure_of(views: ObjectViews, category: Category) -> bool:
    """Return whether the class network is sure of a class: a can on its narrow end resembles a bottle."""
    p = views.class_probabilities
    return bool(p.size) and float(p[CATEGORIES.index(category)]) >= CLEAR


def _is_right_way_up(one: ScoredFit, other: ScoredFit) -> bool:
    """Return whether a lying bottle lies as in one of two fits, and not the other way round as in the other.

    The depth decides where it is clear; else the score, which knows that bottles have necks. Where neither
    fit has one, the score knows nothing of it, and the depth decides again.
    """
    if _is_clearly_closer(one.evidence, other.evidence):
        return True
    if _is_clearly_closer(other.evidence, one.evidence):
        return False
    if min(one.evidence.neck, other.evidence.neck) > NO_NECK:
        return one.evidence.systematic < other.evidence.systematic
    return one.estimate.score > other.estimate.score


def _is_clearly_closer(one: Evidence, other: Evidence) -> bool:
    """Return whether a fit explains no less of the depth, and what both explain much more closely."""
    return misfit(one) <= misfit(other) and one.residual < CLOSER * other.residual
