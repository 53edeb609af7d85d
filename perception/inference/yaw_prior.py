"""Direction of a mug's handle as the yaw network gives it: modes to start from, and a prior of the fit.

Depth alone often leaves the direction open: sensors lose thin handles, or widen them to one side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from perception.detection.yaw import bin_centres
from perception.geometry import upright_rotation
from perception.inference.observation import ObjectObservation
from perception.types import SupportPlane

_MAX_YAWS = 5
_LEAST_LIKELY = 0.3  # smallest probability of a mode relative to the most probable yaw
_YAW_REACH = np.deg2rad(25.0)  # initial yaw error from which a fit converges to the handle
_NARROW = np.deg2rad(9.0)  # standard deviation of the distribution of a handle in plain view


@dataclass(frozen=True)
class YawPrior:
    """Prior on the direction of a handle: a max-mixture of the modes that the yaw network gives.

    Only the mode nearest to the present direction counts (E. Olson and P. Agarwal, "Inference on networks of
    mixtures for robust robot mapping", RSS 2012).

    Attributes:
        directions: (k, 3) unit vectors in the support plane along the x axis of the object, in world
            coordinates.
        certainties: (k,) how certain each mode is, from 0 to 1.
    """

    directions: Float[np.ndarray, "k 3"]
    certainties: Float[np.ndarray, "k"]


def yaw_modes(observations: Sequence[ObjectObservation]) -> list[float]:
    """Return the modes of the fused yaw distribution in radians, the most probable first.

    One mode of a sharp distribution, several of a flat one; none where no view has a distribution.
    """
    p = _fused(observations)
    return [] if p is None else _peaks(p)[0]


def yaw_prior(observations: Sequence[ObjectObservation], plane: SupportPlane) -> YawPrior | None:
    """Return the prior on the direction of a mug's handle; None where no view has a yaw distribution.

    A mode is as certain as it has more probability than a uniform distribution has there, and less so if it
    is wide.
    """
    p = _fused(observations)
    if p is None:
        return None
    yaws, shares = _peaks(p)
    uniform = (2 * _reach(len(p)) + 1) / len(p)
    certainties = np.maximum(np.array(shares) - uniform, 0.0) / max(1 - uniform, 1e-9)
    narrow = np.array([_NARROW / max(_spread(p, yaw), _NARROW) for yaw in yaws])
    directions = np.stack([upright_rotation(plane.normal, yaw)[:, 0] for yaw in yaws])
    return YawPrior(directions, certainties * narrow**2)


def _fused(observations: Sequence[ObjectObservation]) -> Float[np.ndarray, "b"] | None:
    """Return the normalised geometric mean of the yaw distributions of all views; None without any.

    Those that are not finite, are zero, or differ in the number of bins from the first are not used.
    """
    given = [o.yaw_probabilities for o in observations if o.yaw_probabilities.size]
    valid = [p for p in given if np.isfinite(p).all() and p.sum() > 0]
    distributions = [p for p in valid if len(p) == len(valid[0])]
    if not distributions:
        return None
    log_p = np.mean([np.log(np.maximum(p, 1e-4)) for p in distributions], axis=0)
    p = np.exp(log_p - log_p.max())
    return np.asarray(p / p.sum())


def _peaks(p: Float[np.ndarray, "b"]) -> tuple[list[float], list[float]]:
    """Return the modes of a yaw distribution in radians, and the probability around each.

    Non-maximum suppression over ``_YAW_REACH``: one mode of a sharp distribution, several of a flat one.
    """
    bins, reach = len(p), _reach(len(p))
    left, yaws, shares = p.copy(), list[float](), list[float]()
    while len(yaws) < _MAX_YAWS and left.max() > _LEAST_LIKELY * p.max():
        k = int(left.argmax())
        around = np.arange(k - reach, k + reach + 1) % bins
        yaws.append(2 * np.pi * (k + _vertex(p[k - 1], p[k], p[(k + 1) % bins])) / bins)
        shares.append(float(left[around].sum()))
        left[around] = 0.0
    return yaws, shares


def _spread(p: Float[np.ndarray, "b"], yaw: float) -> float:
    """Return the standard deviation of a yaw distribution around one of its modes, in radians."""
    offsets = (bin_centres(len(p)) - yaw + np.pi) % (2 * np.pi) - np.pi
    near = np.abs(offsets) < max(2 * _YAW_REACH, 2 * np.pi / len(p))
    return float(np.sqrt(np.average(offsets[near] ** 2, weights=p[near])))


def _reach(bins: int) -> int:
    """Return ``_YAW_REACH`` in bins."""
    return int(_YAW_REACH / (2 * np.pi) * bins)


def _vertex(left: float, middle: float, right: float) -> float:
    """Return the offset of the vertex of the parabola through three neighbours, in bins."""
    curvature = left - 2 * middle + right
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (left - right) / curvature, -0.5, 0.5))
