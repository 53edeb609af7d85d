"""A grid in plan view, and the cells of samples in it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8


@dataclass(frozen=True)
class PlanGrid:
    """Square cells in plan coordinates; images of it have one pixel per cell, rows along the second axis.

    Attributes:
        low: Corner of the first cell, in metres.
        cell: Side of a cell, in metres.
        shape: Rows and columns.
    """

    low: Float[np.ndarray, "2"]
    cell: float
    shape: tuple[int, int]

    @staticmethod
    def around(plan: Float[np.ndarray, "n 2"], cell: float, margin: float) -> PlanGrid:
        """Return the grid around points with a margin, in metres."""
        low = plan.min(0) - margin
        columns, rows = np.ceil((plan.max(0) + margin - low) / cell).astype(int)
        return PlanGrid(low.astype(np.float32), cell, (int(rows), int(columns)))

    def cells(self, plan: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n"]:
        """Return the index of each point's cell in row-major order, -1 outside the grid."""
        u, v = np.floor((plan - self.low) * np.float32(1 / self.cell)).astype(np.int32).T
        rows, columns = self.shape
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        return np.where(inside, v * columns + u, -1)

    def image(self, cells: Int[np.ndarray, "n"]) -> UInt8[np.ndarray, "r c"]:
        """Return 1 for each of the cells that lie in the grid, else 0."""
        image = np.zeros(self.shape[0] * self.shape[1], np.uint8)
        image[cells[cells >= 0]] = 1
        return image.reshape(self.shape)

    def filled(self, hull: Int[np.ndarray, "m 2"]) -> UInt8[np.ndarray, "r c"]:
        """Return 1 for the cells in a convex polygon of cells (column, row), else 0."""
        return np.asarray(cv2.fillConvexPoly(np.zeros(self.shape, np.uint8), hull.astype(np.int32), 1))

    def polygon(self, hull: Int[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
        """Return the polygon through the middles of cells, counterclockwise, in metres."""
        corners = self.low + (hull + 0.5) * self.cell
        x, y = corners.T
        turn = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum()
        return (corners if turn > 0 else corners[::-1]).astype(np.float64)


def values_at(image: Shaped[np.ndarray, "r c"], cells: Int[np.ndarray, "n"]) -> Shaped[np.ndarray, "n"]:
    """Return the value of each cell of ``PlanGrid.cells``, 0 outside the grid."""
    return np.where(cells >= 0, image.ravel()[cells], 0)


def convex_hull(chosen: Bool[np.ndarray, "r c"]) -> Int[np.ndarray, "m 2"]:
    """Return the corners (column, row) of the convex hull of the chosen cells."""
    return np.asarray(cv2.convexHull(cv2.findNonZero(chosen.astype(np.uint8))))[:, 0]
