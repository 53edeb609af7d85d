"""Convex pieces of perceived meshes, with few corners."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull, QhullError

from manipulation.errors import ManipulationError
from manipulation.standing import split_handle
from manipulation.types import StandingObject

MAX_CORNERS = 48  # about: twice as many directions are tried


def convex_pieces(item: StandingObject) -> tuple[Float[np.ndarray, "_k 3"], ...]:
    """The object as few convex pieces in its stand frame: its hull, or body and handle of a mug."""
    return tuple(hull_corners(part) for part in split_handle(item.vertices, item.category))


def hull_corners(points: Float[np.ndarray, "n 3"], limit: int = MAX_CORNERS) -> Float[np.ndarray, "_k 3"]:
    """Corners of the convex hull, thinned to the extremes along evenly spread directions."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError as error:
        raise ManipulationError("an object's mesh is flat or too small to have a convex hull") from error
    if len(corners) <= limit:
        return corners
    directions = _fibonacci_sphere(2 * limit)
    return corners[np.unique(np.argmax(corners @ directions.T, axis=0))]


def _fibonacci_sphere(count: int) -> np.ndarray:
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    azimuth = np.pi * (1 + 5**0.5) * index
    return np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)


def hull_faces(vertices: Float[np.ndarray, "k 3"]) -> Int[np.ndarray, "_f"]:
    """Triangles of the convex hull of the vertices, wound outwards, three indices after three."""
    hull = ConvexHull(vertices)
    faces = hull.simplices.copy()
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces.ravel()
