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
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.contents import VESSELS
from perception.inference.evidence import Evidence, measure_evidence
from perception.inference.fit import fit_with_grid
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import OnStep
from perception.inference.pose_choice import (
    has_closed_top,
    is_better,
    is_contradicted,
    is_doubtful,
    is_good,
    misfit,
)
from perception.inference.pose_score import agreed, pose_mass
from perception.inference.resting import ALTERNATIVES
from perception.inference.right_way_up import is_turned_over, turned_over
from perception.inference.screening import comes_near, nearest_hypotheses
from perception.inference.shape_model import Decoder
from perception.types import (
    CATEGORIES,
    OTHER,
    POSED_CLASSES,
    Category,
    ObjectEstimate,
    PosedClass,
    RestingPose,
    SupportPlane,
)

logger = logging.getLogger(__name__)

CLEAR = 0.9  # class probability from which on a class with good evidence is not compared with others
MIN_PROBABILITY = 0.02  # of a class that is tried
MAX_CLASSES = 3
SURE = 0.6  # probability of some classes in resting poses from which on they are fitted in any case
LIKELY = 0.15  # least probability of each of them
ABOUT = 0.05  # by how much the misfit of what the pose network is sure of may be larger
ALIKE = 0.02  # difference of the misfits up to which a bottle may lie either way round
UNKNOWN = 0.5  # least score of an object of no class, or in a pose that the networks were not trained on


Axis = tuple[float, float, float] | None
_Fit = Callable[[Category, OnStep | None, RestingPose, Axis], "ScoredFit"]


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
    """A fit as one class in one resting pose.

    Attributes:
        estimate: The estimate, with ``score``.
        evidence: Evidence of the fit.
        probability: Class probability of the detector in the score; None if unknown or not asked.
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

    def fit(
        category: Category,
        report: OnStep | None = None,
        resting: RestingPose = "upright",
        toward: Axis = None,
    ) -> ScoredFit:
        posed = replace(config, resting=resting, toward=toward)
        return scored_fit(replace(views, category=category), decoder, plane, model, posed, report)

    def near(category: Category, resting: RestingPose) -> bool:
        return comes_near(replace(views, category=category), decoder, plane, resting, config)

    p = views.class_probabilities
    threshold = max(model.threshold, UNKNOWN)
    named = _as_named(fit, views, plane, threshold, or_upright=views.is_unclassified)
    if views.is_unclassified:
        if named is None:
            named = _fit_unnamed(fit, nearest_hypotheses(views, decoder, plane, config), views, plane, model)
        return _right_way_up(fit, named, views).estimate
    first, problem = _attempt(fit, views.category, on_step)
    if not p.size:
        best = _best_pose(fit, near, first, (views.category,), views, plane)
        if best is None:
            assert problem is not None
            raise problem
        return _right_way_up(fit, best, views).estimate
    likely = _likely(p)
    upright = _best_upright(fit, first, [c for c in likely if c != views.category], views, plane, model)
    posed = likely if upright is None else (upright.estimate.category,)
    best = _best_pose(fit, near, upright, posed, views, plane, threshold)
    if named is not None and (best is None or misfit(named.evidence) < misfit(best.evidence) + ABOUT):
        best = named
    if best is None:
        assert problem is not None
        raise problem
    best = _right_way_up(fit, best, views)
    estimate = best.estimate
    if estimate.score < model.threshold and len(views.observations) <= 1:
        reason = model.reason(best.evidence, estimate.category, best.probability)
        raise RejectedError(estimate.category, estimate.score, reason)
    if estimate.category != views.category:
        logger.info("object %d: evidence for %s, not %s", views.id, estimate.category, views.category)
    return estimate


def _right_way_up(fit: _Fit, best: ScoredFit, views: ObjectViews) -> ScoredFit:
    """Return the fit, or one the other way round: of a lying bottle, or what has its lower end up."""
    estimate, resting = best.estimate, best.estimate.resting
    may_be_either = estimate.category == "bottle" and resting == "lying"
    if not may_be_either:
        p = dict(zip(POSED_CLASSES, views.pose_probabilities.tolist()))
        if p.get(("bottle", resting), 0.0) > p.get(("can", resting), 0.0):
            return best
        if not is_turned_over(estimate, views.observations):
            return best
    x, y, z = (-estimate.T_world_object[:3, 2]).tolist()
    way = "lying" if resting == "lying" else "upside-down"
    other, _ = _attempt(fit, estimate.category, None, way, (x, y, z))
    if other is None:
        return best
    if may_be_either:
        if _explains_better(other.evidence, best.evidence):
            best, other = other, best
        alike = misfit(other.evidence) < misfit(best.evidence) + ALIKE
        if not alike or not is_turned_over(best.estimate, views.observations):
            return best
    return replace(other, estimate=turned_over(best.estimate, other.estimate))


def _explains_better(one: Evidence, other: Evidence) -> bool:
    """Return whether a fit explains more of the depth, and what both explain more closely.

    A bottle the wrong way round may cover a few pixels more than the right one, but not with its own curve.
    """
    return misfit(one) <= misfit(other) and one.residual <= other.residual


def _best_upright(
    fit: _Fit,
    first: ScoredFit | None,
    rivals: Sequence[Category],
    views: ObjectViews,
    plane: SupportPlane,
    model: AcceptanceModel,
) -> ScoredFit | None:
    """Return the upright fit with the highest score; a contradicted one gives way to one that explains well.

    Args:
        fit: Fits the object.
        first: Fit as the most probable class; None if it failed.
        rivals: Next classes, the most probable first. Where the detector is sure of the first one and only
            the evidence is against it, they must explain the depth well.
        views: Observations of the object.
        plane: Support plane.
        model: Scores the evidence.
    """
    fits = [] if first is None else [first]
    unsure = first is None or first.estimate.score < model.threshold
    unsure = unsure or views.class_probabilities[CATEGORIES.index(views.category)] < CLEAR
    if unsure or (first is not None and is_contradicted(first.evidence)):
        others = [_attempt(fit, category)[0] for category in rivals[: MAX_CLASSES - 1]]
        made = [other for other in others if other is not None]
        good = [other for other in made if is_good(other.evidence, other.estimate, plane)]
        fits += made if unsure else good
    best = max(fits, key=_score, default=None)
    if best is not None and is_contradicted(best.evidence):
        best = max((s for s in fits if is_good(s.evidence, s.estimate, plane)), key=_score, default=best)
    return best


def _as_named(
    fit: _Fit, views: ObjectViews, plane: SupportPlane, threshold: float, or_upright: bool
) -> ScoredFit | None:
    """Return the best good fit as one of the classes in resting poses that the pose network names.

    Args:
        fit: Fits the object.
        views: Observations of the object.
        plane: Support plane.
        threshold: Least score.
        or_upright: Whether upright poses count, which other networks know better.
    """
    likely = {
        posed: p
        for posed, p in zip(POSED_CLASSES, views.pose_probabilities.tolist())
        if p >= LIKELY and (or_upright or posed[1] != "upright")
    }
    if sum(likely.values()) < SURE:
        return None
    good: list[tuple[float, ScoredFit]] = []
    for (category, resting), p in likely.items():
        made, _ = _attempt(fit, category, None, resting)
        accepted = made is not None and made.estimate.score >= threshold
        if made is not None and accepted and is_good(made.evidence, made.estimate, plane):
            good.append((misfit(made.evidence) - ABOUT * p, made))
    return min(good, key=lambda item: item[0])[1] if good else None


def _score(scored: ScoredFit) -> float:
    return scored.estimate.score


def _fit_unnamed(
    fit: _Fit,
    hypotheses: Sequence[PosedClass],
    views: ObjectViews,
    plane: SupportPlane,
    model: AcceptanceModel,
) -> ScoredFit:
    """Return the fit of an object without a class that has the highest score of those at rest and good.

    Raises:
        RejectedError: There is none, or its score is below ``UNKNOWN``.
    """
    good: list[ScoredFit] = []
    for category, resting in hypotheses:
        made, _ = _attempt(fit, category, None, resting)
        if made is not None and is_good(made.evidence, made.estimate, plane):
            good.append(made)
            if made.estimate.score > CLEAR:
                break
    best = max(good, key=_score, default=None)
    if best is None:
        raise RejectedError(views.category, 0.0, "no shape in any resting pose explains the depth")
    if best.estimate.score < max(model.threshold, UNKNOWN):
        reason = model.reason(best.evidence, best.estimate.category, best.probability)
        raise RejectedError(best.estimate.category, best.estimate.score, reason)
    return best


def _likely(p: Float[np.ndarray, "k"]) -> tuple[Category, ...]:
    """Return the classes that the detector does not rule out, the most probable first."""
    order = np.argsort(-p[:OTHER], kind="stable").tolist()
    return tuple(CATEGORIES[k] for k in order if p[k] >= MIN_PROBABILITY)


def _best_pose(
    fit: _Fit,
    near: Callable[[Category, RestingPose], bool],
    upright: ScoredFit | None,
    categories: Sequence[Category],
    views: ObjectViews,
    plane: SupportPlane,
    threshold: float = 0.0,
) -> ScoredFit | None:
    """Return the upright fit, or one of another class or pose that explains the depth clearly better.

    Args:
        fit: Fits the object.
        near: Whether a class in a resting pose comes nearer to the depth than upright, coarsely.
        upright: Best upright fit; None if there is none.
        categories: Classes whose other poses are tried.
        views: Observations of the object.
        plane: Support plane.
        threshold: Least score of another class or pose.
    """
    closed = any(c in VESSELS for c in categories) and has_closed_top(views.observations, plane)
    if upright is not None and not closed and not is_doubtful(upright.evidence, upright.estimate.category):
        return upright
    others = [
        _attempt(fit, c, None, pose)[0] for c in categories for pose in ALTERNATIVES[c] if near(c, pose)
    ]
    before = None if upright is None else upright.evidence
    scored = [o for o in others if o is not None and o.estimate.score >= threshold]
    better = [o for o in scored if is_better(o.evidence, o.estimate, before, plane, closed)]
    if not better:
        return upright
    best = min(better, key=lambda scored: misfit(scored.evidence))
    logger.info("object %d: %s", views.id, best.estimate.resting)
    return best


def _attempt(
    fit: _Fit,
    category: Category,
    on_step: OnStep | None = None,
    resting: RestingPose = "upright",
    toward: Axis = None,
) -> tuple[ScoredFit | None, PerceptionError | None]:
    """Return the fit as a class in a resting pose, or the error that prevents it."""
    try:
        return fit(category, on_step, resting, toward), None
    except PerceptionError as error:
        return None, error


def scored_fit(
    views: ObjectViews,
    decoder: Decoder,
    plane: SupportPlane,
    model: AcceptanceModel,
    config: FitConfig,
    on_step: OnStep | None = None,
) -> ScoredFit:
    """Return the fit of an object as the class of its views, scored by its evidence.

    Raises:
        PerceptionError: The object cannot be fitted.
    """
    category, p = views.category, views.class_probabilities
    estimate, grid = fit_with_grid(views, decoder, plane, config, on_step)
    evidence = measure_evidence(estimate, grid, views.observations, plane, config.step[category])
    is_upright = config.resting == "upright"  # the class network knows upright objects alone
    by_pose = views.pose_probabilities.size > 0 and (views.is_unclassified or not is_upright)
    by_class = p.size > 0 and not by_pose and (is_upright or not views.is_unclassified)
    probability = float(p[CATEGORIES.index(category)]) if by_class else None
    score = model.score(evidence, category, probability)
    if by_pose:
        score = agreed(pose_mass(views.pose_probabilities, config.resting), score)
    return ScoredFit(replace(estimate, score=score), evidence, probability)
