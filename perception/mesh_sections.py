"""Horizontal cross-sections of a triangle mesh, and their intersections with rays."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int


def cross_section(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], z: float
) -> Float[np.ndarray, "s 2 2"]:
    """Return the segments (two end points in x and y) in which the plane at ``z`` [m] cuts the mesh."""
    height = vertices[:, 2] - z
    # A vertex exactly on the plane counts as above it: every crossed triangle then has exactly two cut edges.
    above = height >= 0
    corner_above = above[faces]
    crossed = faces[corner_above.any(axis=1) & ~corner_above.all(axis=1)]
    if len(crossed) == 0:
        return np.zeros((0, 2, 2))
    edges = np.stack([crossed, np.roll(crossed, -1, axis=1)], axis=-1)  # (t, 3, 2)
    cut = above[edges[..., 0]] != above[edges[..., 1]]  # two of three
    a, b = edges[cut][:, 0], edges[cut][:, 1]
    fraction = height[a] / (height[a] - height[b])
    points = vertices[a, :2] + fraction[:, None] * (vertices[b, :2] - vertices[a, :2])
    return points.reshape(-1, 2, 2)


def radial_hits(
    segments: Float[np.ndarray, "s 2 2"], center: Float[np.ndarray, "2"], azimuth: float
) -> Float[np.ndarray, "_h"]:
    """Return the sorted distances [m] at which a ray from the centre crosses the segments.

    Hits less than 0.1 mm apart are merged into one.
    """
    direction = np.array([np.cos(azimuth), np.sin(azimuth)])
    normal = np.array([-direction[1], direction[0]])
    relative = segments - center
    side = relative @ normal  # (s, 2)
    crossing = (side[:, 0] >= 0) != (side[:, 1] >= 0)
    side, relative = side[crossing], relative[crossing]
    fraction = side[:, 0] / (side[:, 0] - side[:, 1])
    hits = (relative[:, 0] + fraction[:, None] * (relative[:, 1] - relative[:, 0])) @ direction
    hits = np.sort(hits[hits > 0])
    return hits[np.append(True, np.diff(hits) > 1e-4)] if len(hits) else hits


def outermost(
    segments: Float[np.ndarray, "s 2 2"], azimuths: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """Return the largest distance [m] at which a ray from the origin crosses the segments, infinite if none.

    Args:
        segments: End points in [m].
        azimuths: Directions of the rays in [rad].
    """
    directions = np.stack([np.cos(azimuths), np.sin(azimuths)])
    side = segments @ np.stack([-directions[1], directions[0]])  # (s, 2, k)
    along = segments @ directions
    crossing = (side[:, 0] >= 0) != (side[:, 1] >= 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = side[:, 0] / (side[:, 0] - side[:, 1])
        hits = along[:, 0] + fraction * (along[:, 1] - along[:, 0])
    hits = np.where(crossing & (hits > 0), hits, -np.inf).max(axis=0, initial=-np.inf)
    return np.where(hits > 0, hits, np.inf)
