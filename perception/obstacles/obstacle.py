"""A thing of no class as convex pieces: plain data that planning shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull


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
            faces = ConvexHull(piece, qhull_options="QJ").equations  # a flat piece has a hull, too
            explained |= (points @ faces[:, :3].T + faces[:, 3] <= margin).all(axis=1)
        return explained
