"""Timing of a curved path: as fast at each of its points as the joint limits allow there.

With the path q(s), 0 <= s <= 1, the joints' velocities are q' ds/dt and their accelerations
q' d²s/dt² + q'' (ds/dt)². The limits bound ds/dt and d²s/dt² at each point; the fastest motion within them is
found by one pass forward and one backward over x = (ds/dt)², in which dx/ds = 2 d²s/dt² (Bobrow, Dubowsky and
Gibson 1985). It jumps in acceleration; the average of s over a moving window of time does not.

Ruckig times paths with the same limits everywhere only: one point near a singularity slows the whole path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import minimum_filter1d

_INTERVALS = 200
_CURVATURE_SHARE = 0.7
_AROUND = 3
_ROUNDS = 3  # of the two passes
_LEAST_SAMPLES = 10  # of a motion, however short its path
_TINY = 1e-9


@dataclass(frozen=True)
class PathLimits:
    """Limits of a motion along a path.

    Attributes:
        velocity, acceleration: (n,) of the joints in [rad/s], [rad/s^2].
        path_velocity, path_acceleration: of s in [1/s], [1/s^2].
        window: time over which s is averaged, in [s].
    """

    velocity: Float[np.ndarray, "n"]
    acceleration: Float[np.ndarray, "n"]
    path_velocity: float
    path_acceleration: float
    window: float

    def slower(self, factor: float) -> PathLimits:
        """Return the limits with which the same path takes about ``factor`` times as long."""
        return PathLimits(
            self.velocity / factor,
            self.acceleration / factor**2,
            self.path_velocity / factor,
            self.path_acceleration / factor**2,
            self.window,
        )


@dataclass(frozen=True)
class PathMotion:
    """Motion along a path from rest to rest, sampled at a fixed period.

    Attributes:
        s, ds, dds: (t,) position on the path, and its derivatives in [1/s], [1/s^2].
    """

    s: Float[np.ndarray, "t"]
    ds: Float[np.ndarray, "t"]
    dds: Float[np.ndarray, "t"]


def fastest(path: CubicSpline, limits: PathLimits, period: float) -> PathMotion:
    """Return the fastest motion along a path q(s), 0 <= s <= 1, that the limits allow, up to its averaging.

    Args:
        path: joint positions [rad] over s.
        limits: limits of the motion; near narrow bends the average may exceed them slightly.
        period: time between samples in [s].
    """
    quickest = 1.0 / (_LEAST_SAMPLES * period)
    path_velocity = min(limits.path_velocity, quickest)
    path_acceleration = min(limits.path_acceleration, quickest**2)
    s = np.linspace(0.0, 1.0, _INTERVALS + 1)
    tangent, curvature = np.abs(path(s, 1)) + _TINY, np.abs(path(s, 2)) + _TINY
    bent = np.sqrt(_CURVATURE_SHARE * limits.acceleration / curvature)
    speed = np.minimum(path_velocity, np.minimum(limits.velocity / tangent, bent).min(axis=1))
    speed = minimum_filter1d(speed, _AROUND)
    speed[[0, -1]] = 0.0
    x = most = speed**2
    for _ in range(_ROUNDS):
        left = limits.acceleration - curvature * x[:, None]  # by the speeds of the round before
        pull = np.minimum(path_acceleration, (left / tangent).min(axis=1))
        x = _profile(most, minimum_filter1d(pull, _AROUND), s[1] - s[0])
    velocity = np.sqrt(x)
    steps = 2.0 * np.diff(s) / np.maximum(velocity[:-1] + velocity[1:], _TINY)
    times = np.concatenate([[0.0], np.cumsum(steps)])
    width = max(1, round(limits.window / period))  # of the average, in samples
    t = period * np.arange(-width, int(np.ceil(times[-1] / period)) + width + 1)
    ds = np.interp(t, times, velocity, left=0.0, right=0.0)
    reached = cumulative_trapezoid(ds, dx=period, initial=0.0)
    ds, reached = ds / reached[-1], reached / reached[-1]
    summed = cumulative_trapezoid(reached, dx=period, initial=0.0)
    averages = [(values[width:] - values[:-width]) / (width * period) for values in (summed, reached, ds)]
    for values, end in zip(averages, (1.0, 0.0, 0.0)):
        values[-1] = end
    return PathMotion(*averages)


def _profile(most: np.ndarray, pull: np.ndarray, step: float) -> Float[np.ndarray, "k"]:
    """Return the largest x = (ds/dt)² below its bounds, with the slopes 2 d²s/dt² that are allowed."""
    x, slopes = most.tolist(), (2.0 * step * np.minimum(pull[:-1], pull[1:])).tolist()
    for i, slope in enumerate(slopes):
        x[i + 1] = min(x[i + 1], x[i] + slope)
    for i in reversed(range(len(slopes))):
        x[i] = min(x[i], x[i + 1] + slopes[i])
    return np.array(x)
