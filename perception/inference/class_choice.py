"""Choice between the classes of an object, and none, by the evidence of its fits.

An object that the detector is sure of is fitted once. Where the detector doubts the class, or the evidence
contradicts it, the next classes are fitted as well, and the one with the highest score is kept.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence, measure_evidence
from perception.inference.fit import fit_with_grid
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import OnStep
from perception.inference.shape_model import Decoder
from perception.types import CATEGORIES, OTHER, Category, ObjectEstimate, SupportPlane

logger = logging.getLogger(__name__)

CLEAR = 0.9  # class probability from which on a class with good evidence is not compared with others
MIN_PROBABILITY = 0.02  # of a class that is tried
MAX_CLASSES = 3


class RejectedError(PerceptionError):
    """The evidence contradicts every class.

    Attributes:
        category: The most probable class.
        score: Its probability, in 0..1.
    """

    def __init__(self, category: Category, score: float, reason: str) -> None:
        super().__init__(f"score {score:.2f}: {reason}")
        self.category: Category = category
        self.score = score


@dataclass(frozen=True)
class ScoredFit:
    """A fit as one class.

    Attributes:
        estimate: The estimate, with ``score``.
        evidence: Evidence of the fit.
        probability: Class probability of the detector; None if unknown.
    """

    estimate: ObjectEstimate
    evidence: Evidence
    probability: float | None


def fit_best_class(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    model: AcceptanceModel,
    config: FitConfig = FitConfig(),
    on_step: OnStep | None = None,
) -> ObjectEstimate:
    """Reconstruct one object as the class with the best evidence; its score is the probability of that class.

    A class given without class probabilities is kept, and its object is never rejected. Nor is an object seen
    in several views: they have confirmed it, and the model is fitted on single views.

    Args:
        views: Observations of the object with its most probable class and its class probabilities.
        decoder: Shape prior.
        plane: Support plane of the object.
        model: Scores the evidence.
        config: Settings of the fits.
        on_step: Called with the progress of the fit as the first class.

    Raises:
        RejectedError: The object is seen once, and the score of its best class is below the threshold.
        PerceptionError: No class can be fitted.
    """

    def fit(category: Category, report: OnStep | None = None) -> ScoredFit:
        return _scored(replace(views, category=category), decoder, plane, model, config, report)

    p = views.class_probabilities
    if not p.size:
        return fit(views.category, on_step).estimate
    first, problem = _attempt(fit, views.category, on_step)
    fits = [] if first is None else [first]
    if first is None or p[CATEGORIES.index(views.category)] < CLEAR or first.estimate.score < model.threshold:
        order = [CATEGORIES[k] for k in np.argsort(-p[:OTHER], kind="stable") if p[k] >= MIN_PROBABILITY]
        for category in [c for c in order if c != views.category][: MAX_CLASSES - 1]:
            other, _ = _attempt(fit, category)
            fits += [] if other is None else [other]
    if not fits:
        assert problem is not None
        raise problem
    best = max(fits, key=lambda scored: scored.estimate.score)
    estimate = best.estimate
    if estimate.score < model.threshold and len(views.observations) <= 1:
        reason = model.reason(best.evidence, estimate.category, best.probability)
        raise RejectedError(estimate.category, estimate.score, reason)
    if estimate.category != views.category:
        logger.info("object %d: evidence for %s, not %s", views.id, estimate.category, views.category)
    return estimate


def _attempt(
    fit: Callable[[Category, OnStep | None], ScoredFit], category: Category, on_step: OnStep | None = None
) -> tuple[ScoredFit | None, PerceptionError | None]:
    """Return the fit as a class, or the error that prevents it."""
    try:
        return fit(category, on_step), None
    except PerceptionError as error:
        return None, error


def _scored(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    model: AcceptanceModel,
    config: FitConfig,
    on_step: OnStep | None,
) -> ScoredFit:
    category, p = views.category, views.class_probabilities
    estimate, grid = fit_with_grid(views, decoder, plane, config, on_step)
    evidence = measure_evidence(estimate, grid, views.observations, plane, config.step[category])
    probability = float(p[CATEGORIES.index(category)]) if p.size else None
    score = model.score(evidence, category, probability)
    return ScoredFit(replace(estimate, score=score), evidence, probability)
