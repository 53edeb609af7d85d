"""Generating curves of surfaces of revolution: profiles in (r, z), fillets, and their radial crossings.

A profile is a polygon in the half-plane r >= 0. It starts and ends on the axis (r = 0) and runs upwards on
the outside, so that revolving it gives a closed surface wound outwards. All lengths in [m].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import PchipInterpolator

Curve = Float[np.ndarray, "_ 2"]  # any number of points: functions change it


def smoothstep(x: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return 3 x² - 2 x³ between 0 and 1, constant outside."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def fillet(vertices: Curve, radii: Float[np.ndarray, "_"], segments: int = 5) -> Curve:
    """Round the inner corners of an open polyline with arcs, keeping its ends.

    An arc never takes more than 45 % of either neighbouring edge: too large a radius is reduced.
    """
    points = []
    done = 0  # vertices before this one are in `points`
    for i in 1 + np.flatnonzero(radii[1:-1] > 0):
        previous, corner, following, radius = vertices[i - 1], vertices[i], vertices[i + 1], radii[i]
        back, ahead = previous - corner, following - corner
        length_back, length_ahead = np.hypot(*back), np.hypot(*ahead)
        if min(length_back, length_ahead) < 1e-9:
            continue
        back, ahead = back / length_back, ahead / length_ahead
        half_angle = 0.5 * np.arccos(np.clip(back @ ahead, -1.0, 1.0))  # of the corner's interior
        if not 1e-3 < half_angle < np.pi / 2 - 1e-3:
            continue
        reach = min(radius / np.tan(half_angle), 0.45 * min(length_back, length_ahead))
        bisector = (back + ahead) / np.linalg.norm(back + ahead)
        centre = corner + bisector * reach / np.cos(half_angle)
        start, end = corner + back * reach - centre, corner + ahead * reach - centre
        turn = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
        angles = np.linspace(0.0, turn, segments + 1)[:, None]
        quarter = np.array([-start[1], start[0]])
        points += [vertices[done:i], centre + np.cos(angles) * start + np.sin(angles) * quarter]
        done = i + 1
    points.append(vertices[done:])
    return np.concatenate(points)


def soften(profile: Curve, radius: float, angle: float = 0.4) -> Curve:
    """Round every corner that turns by more than `angle` [rad], for highlights as on real edges."""
    profile = without_repeats(profile)
    steps = np.diff(profile, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    turn = np.abs((np.diff(heading) + np.pi) % (2 * np.pi) - np.pi)
    radii = np.zeros(len(profile))
    radii[1:-1] = np.where(turn > angle, radius, 0.0)
    return fillet(profile, radii)


def body_curve(radii: Sequence[float], u: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the relative radius at relative heights u of a body given by at least two radii.

    The radii are at equal steps from 0 to 1, with monotone cubic interpolation between them: no bulge or
    waist is deeper than the radii themselves.
    """
    return PchipInterpolator(np.linspace(0.0, 1.0, len(radii)), radii)(u)


def without_repeats(curve: Curve, tolerance: float = 1e-6) -> Curve:
    """Return the curve without points that repeat their predecessor."""
    keep = np.ones(len(curve), dtype=bool)
    keep[1:] = np.abs(np.diff(curve, axis=0)).max(axis=1) > tolerance
    return curve[keep]


def resample(curve: Curve, count: int) -> Curve:
    """Return `count` points at equal steps of arc length."""
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(curve, axis=0).T))])
    at = np.linspace(0.0, length[-1], count)
    return np.stack([np.interp(at, length, curve[:, 0]), np.interp(at, length, curve[:, 1])], axis=1)


def superellipse_arc(exponent: float, count: int = 200) -> Curve:
    """Return half a superellipse |a|ⁿ + |b|ⁿ = 1 with a >= 0, from (0, 1) over (1, 0) to (0, -1)."""
    angle = np.linspace(np.pi / 2, -np.pi / 2, count)
    a = np.abs(np.cos(angle)) ** (2.0 / exponent)
    b = np.sign(np.sin(angle)) * np.abs(np.sin(angle)) ** (2.0 / exponent)
    a[[0, -1]] = 0.0
    return np.stack([a, b], axis=1)


def radial_crossings(profile: Curve, z: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n c"]:
    """Return the radii at which the profile crosses the heights z, largest first, padded with zeros.

    A point (r, z) is inside if an odd number of crossings have a larger radius; the padding never counts.
    """
    (r0, z0), (r1, z1) = profile[:-1].T, profile[1:].T
    z = z[:, None]
    straddles = (z0 <= z) != (z1 <= z)
    rise = np.where(z1 == z0, 1.0, z1 - z0)
    radii = np.where(straddles, r0 + (z - z0) / rise * (r1 - r0), 0.0)
    count = int(straddles.sum(axis=1).max(initial=0))
    largest = (
        np.partition(radii, radii.shape[1] - count, axis=1)[:, radii.shape[1] - count :]
        if count
        else radii[:, :0]
    )
    return np.sort(largest, axis=1)[:, ::-1]


def inside_profile(
    profile: Curve, r: Float[np.ndarray, "n"], z: Float[np.ndarray, "n"], chunk: int = 16384
) -> Bool[np.ndarray, "n"]:
    """Return which points (r, z) lie inside the profile."""
    inside = np.zeros(len(r), dtype=bool)
    for start in range(0, len(r), chunk):
        part = slice(start, start + chunk)
        crossings = radial_crossings(profile, z[part])
        inside[part] = (r[part, None] < crossings).sum(axis=1) % 2 == 1
    return inside
