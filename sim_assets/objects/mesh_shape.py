"""Inside test of any watertight mesh: parity of the crossings of a vertical ray with the triangles above."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from perception.types import Category

NUDGE = np.array([1.3e-7, 2.9e-7])  # offset of the rays from vertices and edges of regular meshes [m]
CELLS = 96  # buckets along each horizontal axis


@dataclass(frozen=True, eq=False)
class MeshShape:
    """Geometry of a mesh file. Object frame: z up, base on z = 0, mug handle along +x."""

    mesh: trimesh.Trimesh
    category: Category

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]:
        return np.asarray(self.mesh.bounds, dtype=np.float64)

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points are inside the mesh."""
        inside = np.zeros(len(points), dtype=bool)
        near = np.flatnonzero(((points >= self.bounds[0]) & (points <= self.bounds[1])).all(axis=1))
        for part in np.array_split(near, len(near) // 50_000 + 1):
            inside[part] = self._crossings_above(points[part]) % 2 == 1
        return inside

    def is_handle(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points of a mug lie towards +x beyond the body, measured on the other side."""
        if self.category != "mug":
            return np.zeros(len(points), dtype=bool)
        r = np.hypot(points[:, 0], points[:, 1])
        z, radius = self._body_radius
        return (points[:, 0] > 0.7 * r) & (r > np.interp(points[:, 2], z, radius) + 2e-3)

    @cached_property
    def _body_radius(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the largest radius in bands of height, of the half that faces away from the handle."""
        points = trimesh.sample.sample_surface(self.mesh, 20_000, seed=0)[0]
        away = points[points[:, 0] < 0]
        edges = np.linspace(self.bounds[0, 2], self.bounds[1, 2], 25)
        band = np.clip(np.digitize(away[:, 2], edges) - 1, 0, 23)
        radius = np.zeros(24)
        np.maximum.at(radius, band, np.hypot(away[:, 0], away[:, 1]))
        return 0.5 * (edges[:-1] + edges[1:]), radius

    @cached_property
    def _triangles(self) -> Float[np.ndarray, "f 3 3"]:
        return np.asarray(self.mesh.triangles, dtype=np.float64)

    @cached_property
    def _buckets(self) -> tuple[np.ndarray, np.ndarray]:
        """Bin the triangles by horizontal cell: (offsets (CELLS² + 1,), triangle indices)."""
        low = self._cell(self._triangles[:, :, :2].min(axis=1))
        high = self._cell(self._triangles[:, :, :2].max(axis=1))
        spans = high - low + 1
        counts = spans.prod(axis=1)
        triangle = np.repeat(np.arange(len(counts)), counts)
        rank = np.arange(len(triangle)) - np.repeat(np.cumsum(counts) - counts, counts)
        column = low[triangle, 0] + rank // spans[triangle, 1]
        row = low[triangle, 1] + rank % spans[triangle, 1]
        cell = column * CELLS + row
        order = np.argsort(cell, kind="stable")
        offsets = np.searchsorted(cell[order], np.arange(CELLS * CELLS + 1))
        return offsets, triangle[order]

    def _cell(self, xy: np.ndarray) -> np.ndarray:
        low, high = self.bounds[:, :2]
        return np.clip(((xy - low) / (high - low) * CELLS).astype(int), 0, CELLS - 1)

    def _crossings_above(self, points: np.ndarray) -> np.ndarray:
        offsets, triangles = self._buckets
        xy = points[:, :2] + NUDGE
        column, row = self._cell(xy).T
        cell = column * CELLS + row
        counts = offsets[cell + 1] - offsets[cell]
        point = np.repeat(np.arange(len(points)), counts)
        rank = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
        corner = self._triangles[triangles[offsets[cell[point]] + rank]]
        a, b, c = (corner[:, i, :2] - xy[point] for i in range(3))
        weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=1)
        total = weights.sum(axis=1)
        hit = ((weights > 0).all(axis=1) | (weights < 0).all(axis=1)) & (total != 0)
        height = (weights[hit] * corner[hit, :, 2]).sum(axis=1) / total[hit]
        above = point[hit][height > points[point[hit], 2]]
        return np.bincount(above, minlength=len(points))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
