"""Cached cross-sections of one mesh, and their extents and fitted circles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from perception.mesh_sections import cross_section


class CrossSectionCache:
    """Cross-sections of one mesh, computed once for each height rounded to 0.1 mm."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self._vertices, self._faces = vertices, faces
        self._cache: dict[float, np.ndarray] = {}

    def at(self, z: float) -> Float[np.ndarray, "s 2 2"]:
        """Return the cross-section at a height in [m]."""
        key = round(float(z), 4)
        if key not in self._cache:
            # Offset from round heights, where meshes often have vertices.
            self._cache[key] = cross_section(self._vertices, self._faces, key + 1e-6)
        return self._cache[key]


@dataclass(frozen=True)
class Extent:
    """Interval that a cross-section covers along a direction.

    Attributes:
        low, high: signed distances of its ends from the frame's origin in [m].
    """

    low: float
    high: float

    @property
    def width(self) -> float:
        """Length of the interval in [m]."""
        return self.high - self.low

    @property
    def middle(self) -> float:
        """Centre of the interval in [m]."""
        return 0.5 * (self.low + self.high)


def extent(segments: Float[np.ndarray, "s 2 2"], azimuth: float) -> Extent | None:
    """Return the extent of a cross-section along a direction; None for an empty one."""
    if len(segments) == 0:
        return None
    along = segments.reshape(-1, 2) @ np.array([np.cos(azimuth), np.sin(azimuth)])
    return Extent(float(along.min()), float(along.max()))


def fit_circle(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Return centre and radius of the least-squares circle (Kasa): |p|^2 = 2 c.p + (r^2 - |c|^2)."""
    system = np.column_stack([2 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)
    center = solution[:2]
    return center, float(np.sqrt(max(solution[2] + center @ center, 0.0)))
