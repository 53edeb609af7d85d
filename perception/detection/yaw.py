"""Discrete distributions over yaw: training labels, rotation to the world frame, fusion, modes.

Bin k of B is centred at 2 pi k / B. The yaw network predicts yaw relative to the viewing direction
(``geometry.view_heading``) of a gravity-aligned crop; detections carry the distribution over world yaw.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

YAW_BINS = 36
_TAU = 2 * np.pi


def bin_centres(bins: int = YAW_BINS) -> Float[np.ndarray, "b"]:
    """Return the yaw at the centre of each bin, in radians."""
    return np.arange(bins) * (_TAU / bins)


def soft_labels(
    yaw: Float[np.ndarray, "n"], bins: int = YAW_BINS, spread: float = np.radians(7.0)
) -> Float[np.ndarray, "n b"]:
    """Return wrapped Gaussians about each yaw, normalised over the bins.

    Args:
        yaw: Angles in radians.
        bins: Number of bins.
        spread: Standard deviation in radians.
    """
    difference = (bin_centres(bins)[None] - yaw[:, None] + np.pi) % _TAU - np.pi
    weight = np.exp(-0.5 * (difference / spread) ** 2)
    return (weight / weight.sum(1, keepdims=True)).astype(np.float32)


def rotate_yaw(probabilities: Float[np.ndarray, "b"], angle: float) -> Float[np.ndarray, "b"]:
    """Return the distribution of (yaw + angle), interpolated linearly between the bins.

    With the heading angle of a view in radians, it maps yaw relative to the view to world yaw.
    """
    bins = len(probabilities)
    position = (np.arange(bins) - angle / _TAU * bins) % bins
    low = np.floor(position).astype(int) % bins
    share = position - np.floor(position)
    return (1 - share) * probabilities[low] + share * probabilities[(low + 1) % bins]


def fuse_yaws(distributions: Sequence[Float[np.ndarray, "b"]], trust: float = 0.95) -> Float[np.ndarray, "b"]:
    """Return the normalised product of independent distributions, each mixed with a uniform one.

    Args:
        distributions: At least one.
        trust: Probability that a distribution is valid; the uniform share 1 - trust bounds the influence of a
            single confident error.
    """
    stack = np.stack(distributions)
    log = np.log(trust * stack + (1 - trust) / stack.shape[1]).sum(0)
    weight = np.exp(log - log.max())
    return weight / weight.sum()


def entropy(probabilities: Float[np.ndarray, "b"]) -> float:
    """Return the entropy in nats: log(B) for a uniform distribution, about 1.5 for a visible handle."""
    p = np.clip(probabilities, 1e-12, None)
    return float(-(p * np.log(p)).sum())


def modes(
    probabilities: Float[np.ndarray, "b"], count: int = 3, min_ratio: float = 0.05
) -> list[tuple[float, float]]:
    """Return up to ``count`` peaks as (yaw in radians, probability mass), most probable first.

    The yaw of a peak is the mean over the five bins around a local maximum, its mass their sum. Peaks with
    less than ``min_ratio`` of the mass of the first are omitted. A uniform distribution yields bin 0.
    """
    p, bins = probabilities, len(probabilities)
    neighbours = np.stack([np.roll(p, -offset) for offset in range(-2, 3)])  # row 2 is p itself
    mass = neighbours.sum(0)
    peaks = np.flatnonzero((p > neighbours[1]) & (p >= neighbours[3]))
    if len(peaks) == 0:
        peaks = np.array([int(p.argmax())])
    peaks = peaks[np.argsort(-mass[peaks])]
    peaks = peaks[mass[peaks] >= min_ratio * mass[peaks[0]]][:count]
    shift = np.arange(-2, 3) @ neighbours / np.maximum(mass, 1e-12)  # in bins
    return [(float((k + shift[k]) * _TAU / bins % _TAU), float(mass[k])) for k in peaks]
