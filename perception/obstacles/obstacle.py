"""A thing of no class as convex pieces: plain data that planning shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

_THIN = 1e-3  # [m] thickness of a piece that spans no volume


@dataclass(frozen=True)
class PerceivedObstacle:
    """A thing of no class.

    Attributes:
        id: Number of the thing.
        pieces: (k, 3) vertices of convex pieces in the world frame, in metres.
        n_points: Number of measured points.
    """

    id: int
    pieces: tuple[Float[np.ndarray, "_k 3"], ...]
    n_points: int

    @property
    def name(self) -> str:
        return f"thing_{self.id}"

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Smallest and largest corner in the world frame, in metres."""
        vertices = np.concatenate(self.pieces)
        return np.stack([vertices.min(axis=0), vertices.max(axis=0)])

    def explains(self, points: Float[np.ndarray, "n 3"], margin: float) -> Bool[np.ndarray, "n"]:
        """Return which world points [m] are in a piece or at most ``margin`` beyond each of its faces."""
        explained = np.zeros(len(points), bool)
        for piece in self.pieces:
            explained |= is_within(points, piece, margin)
        return explained


def is_within(
    points: Float[np.ndarray, "n 3"], piece: Float[np.ndarray, "k 3"], margin: float = 0.0
) -> Bool[np.ndarray, "n"]:
    """Return which points are in a piece's hull or at most ``margin`` beyond each of its faces, in [m]."""
    faces = _faces(piece)
    return np.asarray((points @ faces[:, :3].T + faces[:, 3] <= margin).all(axis=1))


def thickened(points: Float[np.ndarray, "n 3"], edge: float) -> Float[np.ndarray, "m 3"]:
    """Return the corners of a cube with edges of a length [m] about each point."""
    corners = edge * (np.array(list(np.ndindex(2, 2, 2))) - 0.5)
    return (points[:, None] + corners).reshape(-1, 3)


def _faces(piece: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "f 4"]:
    """Return outward normals and offsets [m] of a convex piece's faces; a flat one is given a thickness."""
    try:
        return np.asarray(ConvexHull(piece).equations)
    except QhullError:
        return np.asarray(ConvexHull(thickened(piece, _THIN)).equations)
