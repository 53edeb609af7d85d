"""Scores where the class network is not asked: what the pose network and the evidence of a fit say together.

The class network knows upright objects alone: of what it gave no class, and of what does not stand, the
pose network knows more.
"""

from __future__ import annotations

import numpy as np


def agreed(p: float, q: float) -> float:
    """Return the normalised geometric mean of two probabilities of the same event."""
    yes, no = np.sqrt(p * q), np.sqrt((1 - p) * (1 - q))
    return float(yes / max(yes + no, 1e-12))
