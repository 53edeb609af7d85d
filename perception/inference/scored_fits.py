"""Fits of one object as given classes in given resting poses, scored by their evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from perception.detection.poses import pose_mass
from perception.errors import PerceptionError
from perception.inference.acceptance import AcceptanceModel
from perception.inference.evidence import Evidence, measure_evidence
from perception.inference.fit import fit_with_grid
from perception.inference.fit_config import FitConfig
from perception.inference.observation import ObjectViews
from perception.inference.optimisation import OnStep
from perception.inference.pose_score import agreed
from perception.inference.shape_model import Decoder
from perception.types import (
    CATEGORIES,
    POSED_CLASSES,
    Category,
    ObjectEstimate,
    RestingPose,
    SupportPlane,
)

Axis = tuple[float, float, float]  # direction in world coordinates
_Attempt = tuple[Category, RestingPose, Axis | None, float | None]  # the arguments of an attempt


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
        logistic: Score of the logistic model, where the verifier gave the estimate's; else None.
    """

    estimate: ObjectEstimate
    evidence: Evidence
    probability: float | None
    logistic: float | None = None

    @property
    def preference(self) -> float:
        """Score for the choice between classes: the mean log odds of both models, if both were asked.

        They are different models of different classes, and together they err less often.
        """
        if self.logistic is None:
            return self.estimate.score
        odds = [p / max(1 - p, 1e-12) for p in (self.estimate.score, self.logistic)]
        mean = math.sqrt(odds[0] * odds[1])
        return mean / (1 + mean)


@dataclass(frozen=True)
class ObjectFits:
    """Fits of one object.

    Attributes:
        views: Observations of the object with its most probable class; each fit has a class of its own.
        decoder: Shape prior.
        plane: Support plane of the object.
        model: Scores the evidence.
        config: Settings of the fits.
    """

    views: ObjectViews
    decoder: Decoder
    plane: SupportPlane
    model: AcceptanceModel
    config: FitConfig
    _attempts: dict[_Attempt, ScoredFit | None] = field(default_factory=dict, init=False, repr=False)

    @property
    def threshold(self) -> float:
        """Score below which the object is rejected."""
        return self.model.least_score(len(self.views.observations))

    def pose_probability(self, category: Category, resting: RestingPose) -> float:
        """Return the pose network's probability of a class in a resting pose; 0 if it was not asked."""
        p = dict(zip(POSED_CLASSES, self.views.pose_probabilities.tolist()))
        return p.get((category, resting), 0.0)

    def fit(
        self,
        category: Category,
        resting: RestingPose = "upright",
        toward: Axis | None = None,
        depth_sigma: float | None = None,
        on_step: OnStep | None = None,
    ) -> ScoredFit:
        """Fit the object as a class in a resting pose.

        Args:
            category: The class.
            resting: The resting pose.
            toward: Direction that the object's axis starts near, in world coordinates; None for any.
            depth_sigma: Standard deviation of the depth, in metres; None for that of the settings.
            on_step: Called with the progress.

        Raises:
            PerceptionError: The object cannot be fitted so.
        """
        config = replace(self.config, resting=resting, toward=toward)
        if depth_sigma is not None:
            config = replace(config, noise=replace(config.noise, depth_sigma=depth_sigma))
        views = replace(self.views, category=category)
        return scored_fit(views, self.decoder, self.plane, self.model, config, on_step)

    def attempt(
        self,
        category: Category,
        resting: RestingPose = "upright",
        toward: Axis | None = None,
        depth_sigma: float | None = None,
    ) -> ScoredFit | None:
        """Return the same fit, which is made once; None if the object cannot be fitted so."""
        key = (category, resting, toward, depth_sigma)
        if key not in self._attempts:
            try:
                self._attempts[key] = self.fit(*key)
            except PerceptionError:
                self._attempts[key] = None
        return self._attempts[key]


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
    score, logistic = model.score(evidence, category, probability), None
    if by_class and is_upright and len(views.observations) == 1 and model.verifier is not None:
        score, logistic = model.verifier.score(model.verifier_inputs(evidence, category, p)), score
    if by_pose:
        score = agreed(pose_mass(views.pose_probabilities, config.resting), score)
    return ScoredFit(replace(estimate, score=score), evidence, probability, logistic)
