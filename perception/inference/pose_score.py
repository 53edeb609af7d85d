"""Scores where the class network is not asked: what the pose network and the evidence of a fit say together.

The class network knows upright objects alone: of what it gave no class, and of what does not stand, the
pose network knows more.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.types import POSED_CLASSES, Category, RestingPose


def agreed(p: float, q: float) -> float:
    """Return the normalised geometric mean of two probabilities of the same event."""
    yes, no = np.sqrt(p * q), np.sqrt((1 - p) * (1 - q))
    return float(yes / max(yes + no, 1e-12))


def pose_mass(p: Float[np.ndarray, "p"], resting: RestingPose) -> float:
    """Return the probability that an object of any class rests in a pose; depth decides on the class."""
    return float(sum(q for posed, q in zip(POSED_CLASSES, p.tolist()) if posed[1] == resting))


def class_mass(p: Float[np.ndarray, "p"], category: Category) -> float:
    """Return the probability that an object is of a class, in whatever pose it rests."""
    return float(sum(q for posed, q in zip(POSED_CLASSES, p.tolist()) if posed[0] == category))
