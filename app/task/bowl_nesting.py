"""Geometric criterion of the scorer for bowls that can sit in one another; independent of the planner.

Lower a bowl along the common vertical axis onto another one. With the height T(r) of the lower bowl's topmost
surface and the height U(r) of the upper bowl's lowest surface at radius r, first contact occurs at the lift

    d = max over r of T(r) - U(r)

of the upper base above the lower base. The upper bowl sits in the lower one if d is at most a given share of
the lower bowl's height. T is the maximum and U the minimum over azimuth, so that d holds for every yaw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_bipartite_matching

RADIUS_STEP = 0.0005  # [m] between the radii at which the surfaces are compared
MAX_EDGE = 0.008  # [m]: triangles are subdivided to it, so that edges cross the radii inside them


@dataclass(frozen=True)
class RadialEnvelope:
    """Topmost and lowest surface of a bowl about its axis, at the radii 0, RADIUS_STEP, 2 RADIUS_STEP, ...

    Attributes:
        top: Height T(r) of the topmost surface above the base, in metres; -inf where there is none.
        bottom: Height U(r) of the lowest surface above the base, in metres; inf where there is none.
    """

    top: Float[np.ndarray, "k"]
    bottom: Float[np.ndarray, "k"]


def radial_envelope(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> RadialEnvelope:
    """Return the envelope of a surface in the object frame (axis x = y = 0, z up), in metres."""
    points, triangles = trimesh.remesh.subdivide_to_size(vertices, faces, MAX_EDGE, max_iter=20)[:2]
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    radius, height = np.linalg.norm(points[:, :2], axis=1), points[:, 2]
    edges = np.take_along_axis(edges, np.argsort(radius[edges], axis=1), axis=1)
    (r0, r1), (z0, z1) = radius[edges].T, height[edges].T
    # Interpolate every edge at all sampled radii that it crosses.
    first = np.ceil(r0 / RADIUS_STEP).astype(int)
    count = np.maximum(np.floor(r1 / RADIUS_STEP).astype(int) - first + 1, 0)
    edge = np.repeat(np.arange(len(edges)), count)
    index = first[edge] + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    share = (index * RADIUS_STEP - r0[edge]) / np.maximum(r1 - r0, 1e-12)[edge]
    crossing = z0[edge] + share * (z1 - z0)[edge]
    n_radii = int(radius.max() / RADIUS_STEP) + 1
    top, bottom = np.full(n_radii, -np.inf), np.full(n_radii, np.inf)
    np.maximum.at(top, index, crossing)
    np.minimum.at(bottom, index, crossing)
    return RadialEnvelope(top, bottom)


def resting_lift(upper: RadialEnvelope, lower: RadialEnvelope) -> float:
    """Return the height of the upper base above the lower base at first contact, in metres."""
    shared = min(len(upper.bottom), len(lower.top))
    return float((lower.top[:shared] - upper.bottom[:shared]).max())


def min_nests(envelopes: Sequence[RadialEnvelope], max_lift: float) -> int:
    """Return the smallest number of nests that all bowls can form, no bowl above a smaller one.

    This is a minimum path cover: bowls without a bowl beneath them remain after a maximum matching of upper
    bowls to the bowls that they sit in.

    Args:
        envelopes: Surfaces of the bowls.
        max_lift: Largest resting lift of an upper bowl, as a share of the lower bowl's height.
    """
    ordered = sorted(envelopes, key=lambda envelope: len(envelope.top), reverse=True)
    sits = np.zeros((len(ordered), len(ordered)), dtype=bool)
    for above, upper in enumerate(ordered):
        for below, lower in enumerate(ordered[:above]):
            sits[above, below] = resting_lift(upper, lower) <= max_lift * lower.top.max()
    return len(ordered) - int((maximum_bipartite_matching(csr_array(sits)) >= 0).sum())
