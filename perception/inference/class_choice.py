"""Choice between the classes and resting poses of an object, and none, by the evidence of its fits.

An object that the detector is sure of is fitted once. Where the class is uncertain, or the evidence
contradicts it, the next classes are fitted as well, and the one with the highest score is kept. Where its fit
as an upright object is poor, the other resting poses of the class are tried. An object without a class is
fitted as those classes in those resting poses that come near its depth in a few coarse iterations. In clutter
a network names class and resting pose: what it is sure of is kept if it explains the depth about as well.
"""

from __future__ import annotations

import logging
from dataclasses import replace

from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import OnStep
from perception.inference.resting_choice import (
    as_named,
    best_pose,
    fit_unnamed,
    is_as_named,
)
from perception.inference.scored_fits import ObjectFits, RejectedError, ScoredFit
from perception.inference.shape_model import Decoder
from perception.inference.upright_choice import best_upright, in_poor_depth, likely_classes
from perception.inference.way_round import right_way_up
from perception.types import ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)

POOR = 0.5  # score below which a fit that has not converged is made again
LONGER = 3  # with so many times the iterations


def fit_best_class(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    model: AcceptanceModel,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
    is_detected: bool = True,
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
        is_detected: Whether the detector named the object: a poor fit as its class is given more iterations.

    Raises:
        RejectedError: The object is seen once, or of no class, and its best score is below the threshold.
        PerceptionError: No class can be fitted.
    """
    fits = ObjectFits(views, decoder, plane, model, config)
    named = as_named(fits, or_upright=views.is_unclassified)
    if views.is_unclassified:
        estimate = right_way_up(fits, named or fit_unnamed(fits)).estimate
    else:
        estimate = _best_of_classes(fits, named, on_step, is_detected).estimate
    if not views.is_unclassified and estimate.category != views.category:
        logger.info("object %d: evidence for %s, not %s", views.id, estimate.category, views.category)
    return estimate


def _best_of_classes(
    fits: ObjectFits, named: ScoredFit | None, on_step: OnStep | None, is_detected: bool
) -> ScoredFit:
    """Return the best fit of an object of known or uncertain class.

    Args:
        fits: Fits the object.
        named: Good fit as what the pose network names; None if there is none.
        on_step: Called with the progress of the fit as the first class.
        is_detected: Whether the detector named the object.
    """
    views, model = fits.views, fits.model
    problem: PerceptionError | None = None
    try:
        first = _as_detected(fits, on_step) if is_detected else fits.fit(views.category, on_step=on_step)
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
    best = right_way_up(fits, best)
    if _may_be_rejected(views) and best.estimate.score < fits.threshold:
        usual = in_poor_depth(fits)
        if usual is not None and usual.estimate.score >= fits.threshold:
            return usual
        reason = model.reason(best.evidence, best.estimate.category, best.probability)
        raise RejectedError(best.estimate.category, best.estimate.score, reason)
    return best


def _as_detected(fits: ObjectFits, on_step: OnStep | None) -> ScoredFit:
    """Return the fit as the detected class; that of several views that is poor is given more iterations.

    Unusual shapes that others hide in part take longer to converge.
    """
    first = fits.fit(fits.views.category, on_step=on_step)
    is_poor = first.estimate.status == "not_converged" and first.estimate.score < POOR
    if not is_poor or len(fits.views.observations) == 1 or not fits.views.class_probabilities.size:
        return first
    stages = [replace(stage, iterations=LONGER * stage.iterations) for stage in fits.config.stages]
    again = replace(
        fits, config=replace(fits.config, stages=tuple(stages)), views=replace(fits.views, start=None)
    )
    longer = again.attempt(fits.views.category)
    return first if longer is None or longer.estimate.score <= first.estimate.score else longer


def _may_be_rejected(views: ObjectViews) -> bool:
    return views.class_probabilities.size > 0 and len(views.observations) <= 1
