"""Distributions over yaw in equal bins: labels, the turn from view to world, fusion, modes.

Bin k of B is centred at 2 pi k / B. The network sees a gravity-upright crop and answers relative to the
viewing direction (``geometry.view_heading``); detections carry the distribution over world yaw.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

YAW_BINS = 36
_TAU = 2 * np.pi


def bin_centres(bins: int = YAW_BINS) -> Float[np.ndarray, "b"]:
    return np.arange(bins) * (_TAU / bins)


def soft_labels(
    yaw: Float[np.ndarray, "n"], bins: int = YAW_BINS, spread: float = np.radians(7.0)
) -> Float[np.ndarray, "n b"]:
    """Wrapped Gaussians of standard deviation ``spread`` [rad] about each yaw, summing to one."""
    difference = (bin_centres(bins)[None] - yaw[:, None] + np.pi) % _TAU - np.pi
    weight = np.exp(-0.5 * (difference / spread) ** 2)
    return (weight / weight.sum(1, keepdims=True)).astype(np.float32)


def turned(probabilities: Float[np.ndarray, "b"], angle: float) -> Float[np.ndarray, "b"]:
    """The distribution of (yaw + angle): relative to the view in, world out for the view's heading.

    Between bins it interpolates linearly around the circle.
    """
    bins = len(probabilities)
    position = (np.arange(bins) - angle / _TAU * bins) % bins
    low = np.floor(position).astype(int) % bins
    share = position - np.floor(position)
    return (1 - share) * probabilities[low] + share * probabilities[(low + 1) % bins]


def fused(distributions: Sequence[Float[np.ndarray, "b"]], trust: float = 0.95) -> Float[np.ndarray, "b"]:
    """Normalised product of independent distributions, each held for wrong with probability 1 - trust.

    The uniform share keeps one confident mistake from outvoting the other views.
    """
    stack = np.stack(distributions)
    log = np.log(trust * stack + (1 - trust) / stack.shape[1]).sum(0)
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def entropy(probabilities: Float[np.ndarray, "b"]) -> float:
    """In [nat]: log(B) knows nothing, a handle in plain view about 1.5."""
    p = np.clip(probabilities, 1e-12, None)
    return float(-(p * np.log(p)).sum())


def modes(
    probabilities: Float[np.ndarray, "b"], count: int = 3, min_ratio: float = 0.05
) -> list[tuple[float, float]]:
    """Up to ``count`` peaks (yaw [rad], mass), most probable first.

    A peak's yaw is the mean of the five bins around a local maximum, its mass their sum; peaks below
    ``min_ratio`` of the first are left out. A uniform distribution has no peak and yields bin 0.
    """
    p, bins = probabilities, len(probabilities)
    near = np.stack([np.roll(p, -shift) for shift in range(-2, 3)])  # row 2 is p itself
    mass = near.sum(0)
    peaks = np.flatnonzero((p > near[1]) & (p >= near[3]))
    if len(peaks) == 0:
        peaks = np.array([int(p.argmax())])
    peaks = peaks[np.argsort(-mass[peaks])]
    peaks = peaks[mass[peaks] >= min_ratio * mass[peaks[0]]][:count]
    lean = np.arange(-2, 3) @ near / np.maximum(mass, 1e-12)  # in bins
    return [(float((k + lean[k]) * _TAU / bins % _TAU), float(mass[k])) for k in peaks]
