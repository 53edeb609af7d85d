"""A support plane with the extent over which it was seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from perception.detection.geometry import plan_coordinates, plane_axes
from perception.types import SupportPlane


@dataclass(frozen=True)
class SupportSurface:
    """A plane that objects stand on, and the part of it that was seen.

    Attributes:
        plane: The plane, in the world frame.
        outline: (m, 2) convex polygon around the part that was seen, counterclockwise in plan coordinates
            (``plan_coordinates``), in metres; empty if the extent is unknown.
    """

    plane: SupportPlane
    outline: Float[np.ndarray, "m 2"] = field(default_factory=lambda: np.zeros((0, 2)))

    def beyond(self, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Return how far points lie beyond the outline in plan view, in metres; negative inside.

        Minus infinity if the extent is unknown. Beyond a corner it is the distance from the farther side.
        """
        if not len(self.outline):
            return np.full(len(points_world), -np.inf)
        side = np.roll(self.outline, -1, axis=0) - self.outline
        outwards = np.stack([side[:, 1], -side[:, 0]], axis=1) / np.linalg.norm(side, axis=1)[:, None]
        reach = (outwards * self.outline).sum(1)
        return (plan_coordinates(points_world, self.plane) @ outwards.T - reach).max(1)

    @property
    def corners(self) -> Float[np.ndarray, "m 3"]:
        """World points of the outline in metres."""
        return self.plane.offset * self.plane.normal + self.outline @ plane_axes(self.plane)
