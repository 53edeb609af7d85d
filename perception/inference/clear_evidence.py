"""How good a fit must be for an object that the detector gave no class, or that does not stand upright."""

from __future__ import annotations

from perception.types import ObjectEstimate

UNCLASSIFIED_SCORE = 0.55  # least score of the fit of a candidate that the detector gave no class, upright
POSED_SCORE = 0.85  # the same in other poses: what is no object most often resembles lying ones
# The same of lying bottles, with the odds of their score times (length / LENGTH) ** LENGTH_POWER: pieces of
# things are shorter. Score and length of 118 true and 76 false fits in 70 scans of training families.
BOTTLE_SCORE, LENGTH, LENGTH_POWER = 0.7, 0.12, 4.2
LEAST_SCORE = 0.4  # of a lying bottle of any length
# [m] radius and length below which a lying bottle is a handle: among 223 fits in 74 scans, true ones thinner
# than 21 mm were 0.24 m long and more, false ones of at least the least score at most 0.16 m.
THINNEST, LONG = 0.021, 0.18


def is_clear(estimate: ObjectEstimate) -> bool:
    """Return whether the score suffices for an object that the detector gave no class."""
    if estimate.resting == "upright":
        return estimate.score >= UNCLASSIFIED_SCORE
    if (estimate.category, estimate.resting) == ("bottle", "lying"):
        odds = estimate.score / max(1 - estimate.score, 1e-9) * (estimate.height / LENGTH) ** LENGTH_POWER
        is_likely = estimate.score >= LEAST_SCORE and odds >= BOTTLE_SCORE / (1 - BOTTLE_SCORE)
        return is_likely and not is_thin(estimate)
    return estimate.score >= POSED_SCORE


def is_thin(estimate: ObjectEstimate) -> bool:
    """Return whether a bottle is as thin as the handles of things, and not clearly longer."""
    is_like_handle = estimate.radius < THINNEST and estimate.height < LONG
    return estimate.category == "bottle" and is_like_handle
