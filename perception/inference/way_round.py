"""Which way round an object lies or stands: by its fits both ways, the side of a can, the networks.

A can, or a lying object, that was fitted with the wrong end up is fitted again the other way round. The fits
know necks, lids and tapers alone; the axis network also sees print and caps.
"""

from __future__ import annotations

from dataclasses import replace

from perception.detection.axis import log_odds
from perception.detection.geometry import plane_axes
from perception.inference.evidence import Evidence
from perception.inference.observation import ObjectViews
from perception.inference.pose_choice import is_much_closer, misfit
from perception.inference.resting_choice import LIKELY, is_named_well, other_way_round
from perception.inference.right_way_up import is_turned_over, turned_over
from perception.inference.scored_fits import ObjectFits, ScoredFit
from perception.inference.upright_choice import CLEAR
from perception.types import CATEGORIES, Category

CLOSER = 0.8  # ratio of the residuals from which on the depth tells which way round a bottle lies
# Area of a section near the top, relative to the largest one, from which on a bottle has hardly a neck. Of 28
# lying bottles in 19 scans two had more either way round: the two that were kept the wrong way round.
NO_NECK = 0.65
# Log-odds of the axis network against a fit from which on the object is fitted the other way round. Of 215
# lying bottles in scans of clutter 16 were the wrong way round without the network, 4 with any value to 0.5.
CONTRADICTED = 0.5
SURE = 1.5  # the same where the depth seems to be clear: one of the two fits may have gone astray
ALIKE = 0.02  # difference of the misfits up to which a bottle may lie either way round


def right_way_up(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit, or one the other way round: of what lies, or has its lower end up."""
    if best.estimate.resting == "lying":
        return _along_named_axis(fits, _lying(fits, best))
    if not _has_lower_end_up(fits, best):
        return best
    other = other_way_round(fits, best)
    return best if other is None else _turned_over(best, other)


def _lying(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of what lies, either way round, by the depth."""
    match best.estimate.category:
        case "bottle":
            return _lying_bottle(fits, best)
        case "can":
            return _lying_can(fits, best)
        case _:
            return best


def _along_named_axis(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of what lies, or the one the other way round if the axis network contradicts.

    The depth decides where it is clear and the network is not sure. The score, that it is an object of the
    class, remains.
    """
    odds = _axis_odds(fits, best)
    if odds > -CONTRADICTED:
        return best
    other = other_way_round(fits, best)
    if other is None or _axis_odds(fits, other) < 0:
        return best
    if odds > -SURE and _is_clearly_closer(best.evidence, other.evidence):
        return best
    score = max(best.estimate.score, other.estimate.score)
    return replace(other, estimate=replace(other.estimate, score=score))


def _axis_odds(fits: ObjectFits, fit: ScoredFit) -> float:
    """Return the axis network's log-odds that an object lies as in a fit, not reversed; 0 if not asked."""
    p = fits.views.axis_probabilities
    direction = plane_axes(fits.plane) @ fit.estimate.T_world_object[:3, 2]
    return log_odds(p, direction) if p.size else 0.0


def _lying_bottle(fits: ObjectFits, best: ScoredFit) -> ScoredFit:
    """Return the fit of a lying bottle, or the one the other way round."""
    other = other_way_round(fits, best)
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
    other = other_way_round(fits, best)
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
