"""Choice between the classes of an object that the detector takes for one of them, as if it stood upright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.inference.observation import ObjectObservation
from perception.inference.pose_choice import is_contradicted, is_good, misfit
from perception.inference.scored_fits import ObjectFits, ScoredFit
from perception.types import CATEGORIES, OTHER, Category

CLEAR = 0.9  # class probability from which on a class with good evidence is not compared with others
MIN_PROBABILITY = 0.02  # of a class that is tried
MAX_CLASSES = 3
CLOSE = 0.1  # difference of the scores of two classes that does not decide between them
OVEREXPOSED = 0.5  # share of a mask in which a colour channel is at its limit
LIMIT = 254  # of a colour channel
POOR_DEPTH = 0.02  # [m] standard deviation of the depth of overexposed surfaces


def likely_classes(p: Float[np.ndarray, "k"]) -> tuple[Category, ...]:
    """Return the classes that the detector does not rule out, the most probable first."""
    order = np.argsort(-p[:OTHER], kind="stable").tolist()
    return tuple(CATEGORIES[k] for k in order if p[k] >= MIN_PROBABILITY)


def best_upright(fits: ObjectFits, first: ScoredFit | None, rivals: Sequence[Category]) -> ScoredFit | None:
    """Return the upright fit that is preferred by its score and that no other one surpasses.

    One that the evidence contradicts gives way to one that explains the depth well.

    Args:
        fits: Fits the object.
        first: Fit as the most probable class; None if it failed.
        rivals: Next classes, the most probable first. Where the detector is sure of the first one and only
            the evidence is against it, they must explain the depth well.
    """
    views, threshold = fits.views, fits.threshold
    made = [] if first is None else [first]
    unsure = first is None or first.estimate.score < threshold
    unsure = unsure or views.class_probabilities[CATEGORIES.index(views.category)] < CLEAR
    if unsure or (first is not None and is_contradicted(first.evidence)):
        others = [fits.attempt(category) for category in rivals[: MAX_CLASSES - 1]]
        rival_fits = [other for other in others if other is not None]
        made += rival_fits if unsure else [other for other in rival_fits if _is_good(other, fits)]
    best = max(made, key=_score, default=None)
    if best is None:
        return None
    if is_contradicted(best.evidence):
        return max((s for s in made if _is_good(s, fits)), key=_score, default=best)
    accepted = [s for s in made if s.estimate.score >= threshold and _surpasses(s, best)]
    return max(accepted, key=_score, default=best)


def in_poor_depth(fits: ObjectFits) -> ScoredFit | None:
    """Return the fit of an overexposed object with less trust in its depth; None if it is not, or that fails.

    Cameras that match patterns measure bright surfaces wrongly by centimetres. The shape of the most probable
    class that comes closest to such depth is an unusual one, for which it is rejected.
    """
    if not all(_is_overexposed(seen) for seen in fits.views.observations):
        return None
    return fits.attempt(fits.views.category, depth_sigma=POOR_DEPTH)


def _is_overexposed(seen: ObjectObservation) -> bool:
    brightest = seen.frame.rgb[seen.mask].max(axis=1)
    return bool((brightest >= LIMIT).mean() >= OVEREXPOSED)


def _surpasses(one: ScoredFit, other: ScoredFit) -> bool:
    """Return whether a fit with about the same score is of a more probable class and nearer to the depth.

    Scores of different classes are probabilities of different models: close ones do not decide.
    """
    if one.preference < other.preference - CLOSE:
        return False
    if one.probability is None or other.probability is None or one.probability <= other.probability:
        return False
    return misfit(one.evidence) < misfit(other.evidence) and one.evidence.residual < other.evidence.residual


def _is_good(scored: ScoredFit, fits: ObjectFits) -> bool:
    return is_good(scored.evidence, scored.estimate, fits.plane)


def _score(scored: ScoredFit) -> float:
    return scored.preference
