"""Horizontal sections of a mesh: where its walls are, how thick, how wide it is in a direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from perception.mesh_sections import section


class SectionCache:
    """Sections of one mesh, computed once per height (to 0.1 mm)."""

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        self._vertices, self._faces = vertices, faces
        self._known: dict[float, np.ndarray] = {}

    def at(self, z: float) -> Float[np.ndarray, "s 2 2"]:
        key = round(float(z), 4)
        if key not in self._known:
            # Off the round height, where meshes like to have their vertices.
            self._known[key] = section(self._vertices, self._faces, key + 1e-6)
        return self._known[key]


@dataclass(frozen=True)
class Span:
    """Extent of a section along a direction: from ``low`` to ``high`` in [m]."""

    low: float
    high: float

    @property
    def width(self) -> float:
        return self.high - self.low

    @property
    def middle(self) -> float:
        return 0.5 * (self.low + self.high)


def span(segments: Float[np.ndarray, "s 2 2"], azimuth: float) -> Span | None:
    """Extent of the section along a direction, from the frame's origin; None for an empty section."""
    if len(segments) == 0:
        return None
    along = segments.reshape(-1, 2) @ np.array([np.cos(azimuth), np.sin(azimuth)])
    return Span(float(along.min()), float(along.max()))


def fit_circle(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Centre and radius of the least-squares circle (Kasa): |p|^2 = 2 c.p + (r^2 - |c|^2)."""
    system = np.column_stack([2 * points, np.ones(len(points))])
    solution, *_ = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)
    center = solution[:2]
    return center, float(np.sqrt(max(solution[2] + center @ center, 0.0)))
