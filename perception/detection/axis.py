"""Which end of a lying object is its top: odds from distributions over the direction of its axis.

Bins are those of ``yaw``: bin k of B is centred at 2 pi k / B about the support normal. A direction counts
for one end of a known axis by the probability within a quarter turn of it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.detection.yaw import bin_centres

TRUST = 0.98  # probability that a distribution is valid; bounds the influence of a single confident error


def along(angle: float) -> Float[np.ndarray, "2"]:
    """Return the direction in the plane at an angle from its first axis, in radians."""
    return np.array([np.cos(angle), np.sin(angle)])


def log_odds(probabilities: Float[np.ndarray, "b"], direction: Float[np.ndarray, "2"]) -> float:
    """Return the logarithm of the odds that an axis points in a direction and not in the opposite one.

    Args:
        probabilities: Distribution over the directions of the axis.
        direction: Direction in the plane, of any length.
    """
    angle = float(np.arctan2(direction[1], direction[0]))
    share = np.heaviside(np.cos(bin_centres(len(probabilities)) - angle).round(9), 0.5)  # across: either way
    p = TRUST * probabilities + (1 - TRUST) / len(probabilities)
    return float(np.log(p @ share) - np.log(p @ (1 - share)))
