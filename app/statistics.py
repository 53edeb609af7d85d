"""Rates with their uncertainty."""

from __future__ import annotations

import math

Z_95 = 1.959963984540054  # two-sided 95 % quantile of the normal distribution


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson's score interval of a success rate (E. B. Wilson, JASA 22, 1927); (0, 1) without trials.

    Centre (p + z²/2n) / (1 + z²/n), half-width z sqrt(p(1-p)/n + z²/4n²) / (1 + z²/n).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials")
    if trials == 0:
        return 0.0, 1.0
    p, ratio = successes / trials, z * z / trials
    centre = (p + ratio / 2) / (1 + ratio)
    half = z * math.sqrt(p * (1 - p) / trials + ratio / (4 * trials)) / (1 + ratio)
    return max(0.0, centre - half), min(1.0, centre + half)
