"""How good a fit must be for an object that the detector gave no class, or that does not stand upright."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.geometry import invert, transform_points
from perception.inference.evidence import section_shapes
from perception.types import ObjectEstimate

# Least score of the fit of an upright candidate that the detector gave no class. In 21 scans of clutter true
# objects had 0.77 and more, a stool that two images showed 0.57.
UNCLASSIFIED_SCORE = 0.65
POSED_SCORE = 0.85  # the same in other poses: what is no object most often resembles lying ones
# The same of lying bottles, with the odds of their score times (length / LENGTH) ** LENGTH_POWER: pieces of
# things are shorter. Score and length of 118 true and 76 false fits in 70 scans of training families.
BOTTLE_SCORE, LENGTH, LENGTH_POWER = 0.7, 0.12, 4.2
# Of a lying bottle of any length. On 45 tables of test families, 74 true ones had 0.66 and more, two staplers
# as long as bottles 0.51 and 0.53.
LEAST_SCORE = 0.6
# Least score of what may be a part of a thing: parts resemble objects more often. A lying bottle needs its
# odds for its length: of the fits with a lower score that had them, in 74 scans, 25 were true, 6 were of a
# bottle in part, and 1 was of a can.
PIECE_SCORE = 0.85
# Area of a section near the top, relative to the largest one, from which on a lying bottle has no neck, and
# needs the odds of PIECE_SCORE: in 74 scans, that left out 7 of 14 false fits and 4 of 114 true ones.
NECK = 0.8
# [m] radius and length below which a lying bottle is a handle: those of tools are up to 38 mm thick. Among
# 223 fits in 74 scans, true ones thinner than 21 mm were 0.24 m long and more, false ones of at least the
# least score at most 0.16 m; bottles of 40 mm and 0.16 m are met as well.
THINNEST, LONG = 0.0195, 0.18
# [m] half widths of a flat bottle, as of ketchup, from which on it is none: handles are about round.
FLAT, BROAD = 0.015, 0.024
# Height of a lying bottle in diameters below which it is none: 247 true ones had 1.87 and more, a camera and
# a can 1.35 and 1.65.
STUBBY = 1.75
_LID = 0.6  # share of the radius within which points are on an end
_AT_END = 0.01  # [m] from it
_FEWEST = 10  # of 2000 to 5000 points


def is_clear(estimate: ObjectEstimate) -> bool:
    """Return whether the score suffices for an object that the detector gave no class."""
    if estimate.resting == "upright":
        return estimate.score >= UNCLASSIFIED_SCORE
    if (estimate.category, estimate.resting) == ("bottle", "lying"):
        if is_stubby(estimate):
            return False
        has_neck = section_shapes(estimate)[0] < NECK
        return _is_likely_bottle(estimate, BOTTLE_SCORE if has_neck else PIECE_SCORE)
    return estimate.score >= POSED_SCORE


def may_be_part(estimate: ObjectEstimate) -> bool:
    """Return whether an object that the detector gave no class may be a part of a thing, by its score."""
    if (estimate.category, estimate.resting) == ("bottle", "lying"):
        return not _is_likely_bottle(estimate, PIECE_SCORE)
    return estimate.score < PIECE_SCORE


def shows_ends(estimate: ObjectEstimate, points: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether both ends of a lying can were measured; of other objects they need not be.

    A lens, or the end of a handle, is a can one of whose ends is on the rest of the thing.

    Args:
        estimate: The estimate.
        points: Measured points of the object in the world frame, in metres.
    """
    if (estimate.category, estimate.resting) != ("can", "lying"):
        return True
    own = transform_points(invert(estimate.T_world_object), points)
    low, high = estimate.mesh.vertices.min(axis=0), estimate.mesh.vertices.max(axis=0)
    from_axis = np.linalg.norm((own - (low + high) / 2)[:, :2], axis=1)
    inner = own[from_axis < _LID * estimate.radius, 2]
    return all((np.abs(inner - end) < _AT_END).sum() >= _FEWEST for end in (low[2], high[2]))


def _is_likely_bottle(estimate: ObjectEstimate, usual: float) -> bool:
    """Return whether a lying bottle has at least the least score, and the odds of a score for its length."""
    odds = estimate.score / max(1 - estimate.score, 1e-9) * (estimate.height / LENGTH) ** LENGTH_POWER
    return estimate.score >= LEAST_SCORE and odds >= usual / (1 - usual) and not is_thin(estimate)


def is_stubby(estimate: ObjectEstimate) -> bool:
    """Return whether a bottle is too short for its diameter."""
    return estimate.category == "bottle" and estimate.height < STUBBY * 2 * estimate.radius


def is_thin(estimate: ObjectEstimate) -> bool:
    """Return whether a lying bottle is as thin as the handles of things, and neither longer nor flat."""
    if estimate.radius >= THINNEST or estimate.height >= LONG:
        return False
    broad = float(np.ptp(estimate.mesh.vertices[:, 0]) / 2)
    return estimate.radius < FLAT or broad < BROAD
