"""Convex hulls of object meshes, reduced to few vertices for collision checking."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from manipulation.errors import ManipulationError
from manipulation.standing import split_handle
from manipulation.types import StandingObject
from manipulation.uncertainty import outer_vertices

MAX_VERTICES = 48  # target; at most twice as many remain, one for each sampled direction
_FLAT = 1e-5  # [m] deviation of points from a plane below which they are flat


def convex_pieces(item: StandingObject) -> tuple[Float[np.ndarray, "_k 3"], ...]:
    """Return the object's convex pieces in its stand frame: body and handle of a mug, else one hull.

    Uncertain parts are widened.
    """
    return tuple(reduced_hull(part) for part in split_handle(outer_vertices(item), item.category))


def reduced_hull(points: Float[np.ndarray, "n 3"], limit: int = MAX_VERTICES) -> Float[np.ndarray, "_k 3"]:
    """Return convex-hull vertices, reduced to extreme points along 2 * ``limit`` evenly spread directions.

    A hull of at most ``limit`` vertices is returned unchanged.

    Raises:
        ManipulationError: the points span no volume.
    """
    try:
        vertices = points[ConvexHull(points).vertices]
    except QhullError as error:
        raise ManipulationError("an object's mesh is flat or too small to have a convex hull") from error
    if len(vertices) <= limit:
        return vertices
    directions = _fibonacci_sphere(2 * limit)
    reduced = vertices[np.unique(np.argmax(vertices @ directions.T, axis=0))]
    # A low apex of a wide sheet is extreme in few directions; without it, nothing spans a volume.
    thickness = np.linalg.svd(reduced - reduced.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(reduced))
    return reduced if len(reduced) > 3 and thickness > _FLAT else vertices


def _fibonacci_sphere(count: int) -> np.ndarray:
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + 5**0.5) * index
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)


def hull_faces(vertices: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "_f"]:
    """Return the hull's triangles, counterclockwise seen from outside, as a flat list of vertex indices."""
    hull = ConvexHull(vertices)
    faces = hull.simplices.copy()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces.ravel()
