"""Objects seen from above: outlines, and a raster of the box with what stands in it and how high."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import fftconvolve
from scipy.spatial import ConvexHull

from manipulation.standing import split_handle
from manipulation.types import Box, StandingObject

_DIRECTIONS = 2 * np.pi * np.arange(32) / 32


@dataclass(frozen=True)
class Footprint:
    """What an object covers: convex outlines (k, 2) in the stand frame in [m], and how high it is."""

    outlines: tuple[Float[np.ndarray, "_k 2"], ...]
    top: float

    def turned(self, yaw: float) -> Footprint:
        """The footprint of the object turned about z."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s], [-s, c]])
        return Footprint(tuple(outline @ turn for outline in self.outlines), self.top)

    def reach(self, direction: Float[np.ndarray, "2"]) -> float:
        """How far it extends from the origin in a direction, in [m]."""
        return max(float((outline @ direction).max()) for outline in self.outlines)

    def covers(self, points: Float[np.ndarray, "*n 2"], gap: float = 0.0) -> Bool[np.ndarray, "*n"]:
        """Which points lie within ``gap`` [m] of it (corners are bevelled, not rounded)."""
        inside = np.zeros(points.shape[:-1], dtype=bool)
        normals = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1)
        for outline in self.outlines:
            support = (outline @ normals.T).max(axis=0)
            inside |= np.all(points @ normals.T <= support + gap, axis=-1)
        return inside


def footprint(item: StandingObject) -> Footprint:
    """Hull of the object seen from above; body and handle apart for a mug."""
    parts = split_handle(item.vertices, item.category)
    return Footprint(tuple(_hull(part[:, :2]) for part in parts), item.top)


def _hull(points: np.ndarray) -> np.ndarray:
    return points[ConvexHull(points).vertices]


@dataclass(frozen=True)
class Stencil:
    """A footprint in cells around its origin: covered exactly, and covered with a gap around it."""

    exact: Bool[np.ndarray, "m m"]
    widened: Bool[np.ndarray, "m m"]
    top: float

    @staticmethod
    def of(shape: Footprint, gap: float, cell: float) -> Stencil:
        size = max(shape.reach(direction) for direction in np.concatenate([np.eye(2), -np.eye(2)]))
        count = int(np.ceil((size + gap) / cell)) + 1
        offsets = cell * np.arange(-count, count + 1)
        cells = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1)
        return Stencil(shape.covers(cells), shape.covers(cells, gap), shape.top)


class BoxRaster:
    """A box from above in cells: which are taken, and how high things stand in and around it.

    Coordinates are relative to the box's centre; heights reach past the walls, so that a hand above them can
    be checked.
    """

    def __init__(self, box: Box, wall_gap: float, cell: float = 0.005, around: float = 0.12) -> None:
        self.cell = cell
        half = np.array(box.size[:2]) / 2
        count = [int(np.ceil((h + around) / cell)) for h in half]
        self.x, self.y = (cell * (np.arange(-n, n) + 0.5) for n in count)
        self.centers = np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)
        distance = np.abs(self.centers)
        self.taken = np.asarray((distance > half - wall_gap).any(axis=-1))
        inside = (distance <= half).all(axis=-1)
        within = (distance <= half + box.wall + cell).all(axis=-1)
        self.heights = np.where(inside, box.floor, np.where(within, box.top, 0.0))
        # Nothing stands outside the walls: the search for places looks at the inside alone.
        rows, columns = np.nonzero(~self.taken)
        self._inner = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)

    def copy(self) -> BoxRaster:
        """An independent raster with the same contents."""
        other = object.__new__(BoxRaster)
        other.__dict__.update(self.__dict__, taken=self.taken.copy(), heights=self.heights.copy())
        return other

    def free_positions(self, stencil: Stencil) -> Bool[np.ndarray, "nx ny"]:
        """Cells on whose centre the stencil's origin may stand, gap included."""
        free = ~self.taken[self._inner]
        kernel = stencil.widened[::-1, ::-1].astype(np.float32)
        covered = fftconvolve(np.pad(free, len(kernel) // 2).astype(np.float32), kernel, mode="valid")
        result = np.zeros(self.taken.shape, dtype=bool)
        result[self._inner] = covered > kernel.sum() - 0.5
        return result

    def add(self, stencil: Stencil, cell: tuple[int, int], base: float = 0.0) -> None:
        """Stand a stencil with its origin in a cell, its base at a height."""
        reach = len(stencil.exact) // 2
        i, j = cell
        low = max(i - reach, 0), max(j - reach, 0)
        window = (slice(low[0], i + reach + 1), slice(low[1], j + reach + 1))
        part = stencil.exact[low[0] - i + reach :, low[1] - j + reach :]
        part = part[: self.taken[window].shape[0], : self.taken[window].shape[1]]
        self.taken[window] |= part
        self.heights[window] = np.where(
            part, np.maximum(self.heights[window], base + stencil.top), self.heights[window]
        )

    def highest(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Height of what stands at points relative to the centre in [m]; 0 outside the raster."""
        nx, ny = self.heights.shape
        i = np.floor(points[..., 0] / self.cell).astype(int) + nx // 2
        j = np.floor(points[..., 1] / self.cell).astype(int) + ny // 2
        known = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
        return np.where(known, self.heights[np.where(known, i, 0), np.where(known, j, 0)], 0.0)


def bounding_area(shapes: Sequence[Footprint], positions: Sequence[Float[np.ndarray, "2"]]) -> float:
    """Area of the upright rectangle around standing shapes in [m^2]."""
    if not shapes:
        return 0.0
    corners = np.concatenate([o + p for s, p in zip(shapes, positions) for o in s.outlines])
    return float(np.prod(np.ptp(corners, axis=0)))
