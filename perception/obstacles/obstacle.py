"""A thing of no class as convex pieces: plain data that planning shares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


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
