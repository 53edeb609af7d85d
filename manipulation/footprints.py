"""Top-view outlines of objects, and a raster of occupancy and height of a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.signal import fftconvolve
from scipy.spatial import ConvexHull

from manipulation.standing import split_handle
from manipulation.types import Box, StandingObject
from manipulation.uncertainty import outer_vertices

RIM = (
    0.002  # [m] added to the walls: the planner lets no hand in where the samples of the palm just clear them
)
_DIRECTIONS = 2 * np.pi * np.arange(32) / 32


@dataclass(frozen=True)
class Footprint:
    """Area that an object covers.

    Attributes:
        outlines: (k, 2) vertices of convex outlines in the stand frame in [m].
        top: height of the object in [m].
    """

    outlines: tuple[Float[np.ndarray, "_k 2"], ...]
    top: float

    def rotated(self, yaw: float) -> Footprint:
        """Return the footprint rotated by ``yaw`` [rad] about z."""
        c, s = np.cos(yaw), np.sin(yaw)
        R_T = np.array([[c, s], [-s, c]])  # transposed, for row vectors
        return Footprint(tuple(outline @ R_T for outline in self.outlines), self.top)

    def reach(self, direction: Float[np.ndarray, "2"]) -> float:
        """Return the largest distance [m] from the origin along a unit direction (support function)."""
        return max(float((outline @ direction).max()) for outline in self.outlines)

    def covers(self, points: Float[np.ndarray, "*n 2"], gap: float = 0.0) -> Bool[np.ndarray, "*n"]:
        """Return which points lie within ``gap`` [m] of the outlines (corners bevelled, not rounded)."""
        inside = np.zeros(points.shape[:-1], dtype=bool)
        normals = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1)
        for outline in self.outlines:
            support = (outline @ normals.T).max(axis=0)
            inside |= np.all(points @ normals.T <= support + gap, axis=-1)
        return inside


def footprint(item: StandingObject) -> Footprint:
    """Return the convex outlines, widened where uncertain: body and handle of a mug, else one."""
    parts = split_handle(outer_vertices(item), item.category)
    return Footprint(tuple(_hull(part[:, :2]) for part in parts), item.top)


def _hull(points: np.ndarray) -> np.ndarray:
    return points[ConvexHull(points).vertices]


@dataclass(frozen=True)
class Stencil:
    """A footprint rasterised around its origin.

    Attributes:
        exact: cells that the footprint covers.
        widened: cells within a gap around it.
        top: height of the object in [m].
    """

    exact: Bool[np.ndarray, "m m"]
    widened: Bool[np.ndarray, "m m"]
    top: float

    @staticmethod
    def of(shape: Footprint, gap: float, cell: float) -> Stencil:
        """Rasterise a footprint with a gap [m] in cells of a given edge length [m]."""
        size = max(shape.reach(direction) for direction in np.concatenate([np.eye(2), -np.eye(2)]))
        count = int(np.ceil((size + gap) / cell)) + 1
        offsets = cell * np.arange(-count, count + 1)
        cells = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), axis=-1)
        return Stencil(shape.covers(cells), shape.covers(cells, gap), shape.top)


class BoxRaster:
    """Top-view raster of a box: occupied cells and the height of the scene.

    Coordinates are relative to the box's centre. The raster extends beyond the walls, where the palm may be.

    Args:
        box: box to rasterise.
        wall_gap: distance from the walls within which cells are occupied, in [m].
        cell: edge length of a cell in [m].
        margin: extent of the raster beyond the inside of the box in [m].

    Attributes:
        x, y: (nx,), (ny,) coordinates of the cell centres in [m].
        centers: (nx, ny, 2) cell centres in [m].
        taken: (nx, ny) occupied cells.
        heights: (nx, ny) height of the scene above the table in [m].
    """

    def __init__(self, box: Box, wall_gap: float, cell: float = 0.005, margin: float = 0.12) -> None:
        self.cell = cell
        half = np.array(box.size[:2]) / 2
        count = [int(np.ceil((h + margin) / cell)) for h in half]
        self.x, self.y = (cell * (np.arange(-n, n) + 0.5) for n in count)
        self.centers = np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)
        distance = np.abs(self.centers)
        self.taken = np.asarray((distance > half - wall_gap).any(axis=-1))
        inside = (distance <= half).all(axis=-1)
        within = (distance <= half + box.wall + cell).all(axis=-1)
        self.heights = np.where(inside, box.floor, np.where(within, box.top + RIM, 0.0))
        # Objects stand inside the walls: the search is limited to the free interior.
        rows, columns = np.nonzero(~self.taken)
        self._inner = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)

    def copy(self) -> BoxRaster:
        """Return an independent copy."""
        other = object.__new__(BoxRaster)
        other.__dict__.update(self.__dict__, taken=self.taken.copy(), heights=self.heights.copy())
        return other

    def free_positions(self, stencil: Stencil) -> Bool[np.ndarray, "nx ny"]:
        """Return the cells at which the stencil, including its gap, covers no occupied cell."""
        free = np.zeros(self.taken.shape, dtype=bool)
        taken, kernel = self.taken[self._inner].astype(np.uint8), stencil.widened.astype(np.uint8)
        # Dilation takes a half to a tenth of the time of a convolution for stencils of this size.
        free[self._inner] = cv2.dilate(taken, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1) == 0
        return free

    def free_within(self, stencil: Stencil) -> Float[np.ndarray, "nx ny"]:
        """Return the number of free cells that the stencil, including its gap, covers at each cell."""
        free = ~self.taken[self._inner]
        kernel = stencil.widened[::-1, ::-1].astype(np.float32)
        result = np.zeros(self.taken.shape, dtype=np.float32)
        padded = np.pad(free, len(kernel) // 2).astype(np.float32)
        result[self._inner] = fftconvolve(padded, kernel, mode="valid")
        return result

    def cell_of(self, position: Float[np.ndarray, "2"]) -> tuple[int, int]:
        """Return the cell that contains a position [m] relative to the centre."""
        i, j = self._indices(position)
        return int(i), int(j)

    def add(self, stencil: Stencil, cell: tuple[int, int], base: float = 0.0) -> None:
        """Occupy the cells of a stencil with its origin in a cell and its base at a height [m]."""
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
        """Return the height [m] of the scene at points relative to the centre; 0 outside the raster."""
        nx, ny = self.heights.shape
        i, j = np.moveaxis(self._indices(points), -1, 0)
        known = (i >= 0) & (i < nx) & (j >= 0) & (j < ny)
        return np.where(known, self.heights[np.where(known, i, 0), np.where(known, j, 0)], 0.0)

    def _indices(self, points: Float[np.ndarray, "*n 2"]) -> Int[np.ndarray, "*n 2"]:
        """Return the indices of the cells that contain points [m] relative to the centre, also outside."""
        return np.floor(points / self.cell).astype(int) + np.array(self.taken.shape) // 2


def bounding_area(shapes: Sequence[Footprint], positions: Sequence[Float[np.ndarray, "2"]]) -> float:
    """Return the area [m^2] of the axis-aligned bounding rectangle of footprints at positions."""
    if not shapes:
        return 0.0
    corners = np.concatenate([o + p for s, p in zip(shapes, positions) for o in s.outlines])
    return float(np.prod(np.ptp(corners, axis=0)))
