"""Sums over the probabilities of classes in resting poses that the pose network predicts."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.types import POSED_CLASSES, Category, RestingPose


def pose_mass(p: Float[np.ndarray, "p"], resting: RestingPose) -> float:
    """Return the probability that an object of any class rests in a pose; depth decides on the class."""
    return float(sum(q for posed, q in zip(POSED_CLASSES, p.tolist()) if posed[1] == resting))


def class_mass(p: Float[np.ndarray, "p"], category: Category) -> float:
    """Return the probability that an object is of a class, in whatever pose it rests."""
    return float(sum(q for posed, q in zip(POSED_CLASSES, p.tolist()) if posed[0] == category))
