"""The extent over which a plane was seen as a surface, on a grid in plan view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.detection.geometry import plane_axes
from perception.support.plan_grid import PlanGrid, convex_hull, values_at
from perception.support.planes import PlaneConfig, on_plane, tolerance
from perception.support.samples import Samples
from perception.types import SupportPlane


@dataclass(frozen=True)
class ExtentConfig:
    """Parameters of the extent of a surface; lengths in metres.

    Attributes:
        cell: Side of the grid's cells.
        bridge: Largest gap that is closed: samples of a surface at a grazing angle are that far apart.
        min_width: Width below which a strip is the side of something that the plane passes through.
        min_area: Smallest area of a part of a surface, in square metres: that of a side plate.
        max_gap_share: Largest share of the gap between two parts of one surface through which something
            below was seen; the rest is hidden by what stands on the surface, or was not measured.
    """

    cell: float = 0.02
    bridge: float = 0.08
    min_width: float = 0.06
    min_area: float = 0.015
    max_gap_share: float = 0.2


@dataclass(frozen=True)
class Extent:
    """Where a plane was seen as a surface.

    Attributes:
        plane: The plane, in the world frame.
        grid: Grid in plan view.
        hull: (m, 2) corners (column, row) of the extent.
        inside: Image of the grid: 1 in the extent.
        cells: (n,) cell of each sample, -1 outside the grid.
        height: (n,) height of each sample above the plane, in metres.
        noise: (n,) largest distance from the plane of a sample on it, in metres.
        shown: (n,) samples that show the surface.
    """

    plane: SupportPlane
    grid: PlanGrid
    hull: Int[np.ndarray, "m 2"]
    inside: UInt8[np.ndarray, "r c"]
    cells: Int[np.ndarray, "n"]
    height: Float[np.ndarray, "n"]
    noise: Float[np.ndarray, "n"]
    shown: Bool[np.ndarray, "n"]


def seen_extent(
    samples: Samples, plane: SupportPlane, planes: PlaneConfig, config: ExtentConfig
) -> Extent | None:
    """Return the extent of a plane; None if no part of it was seen as a surface.

    It is the convex hull of the part with the most samples and of those that nothing but occlusion separates
    from it.
    """
    core, height = on_plane(samples, plane, planes)
    # Normals are unknown beside discontinuities: their neighbours on the plane are part of the surface.
    noise = tolerance(samples, planes)
    core = samples.beside(core) & samples.valid & (np.abs(height) < noise)
    if core.sum() < 10:
        return None
    plan = samples.points @ plane_axes(plane).T.astype(np.float32)
    grid = PlanGrid.around(plan[core], config.cell, config.bridge)
    cells = grid.cells(plan)
    parts = _parts(grid, cells[core], config)
    if not parts:
        return None
    seen_from_above = plane.height_above(samples.centres)[samples.view] > 0
    below = samples.valid & seen_from_above & (height < -2 * noise)
    through = grid.image(grid.cells(_crossings(samples, plane, plan, height, below)))
    hull = _united(grid, parts, through > 0, config)
    inside = grid.filled(hull)
    return Extent(plane, grid, hull, inside, cells, height, noise, core & (values_at(inside, cells) > 0))


def _parts(
    grid: PlanGrid, cells: Int[np.ndarray, "k"], config: ExtentConfig
) -> list[Int[np.ndarray, "_m 2"]]:
    """Return the convex hulls (column, row) of the connected parts, that with the most samples first.

    Gaps between samples are closed, then narrow strips are removed.
    """

    def disc(width: float) -> np.ndarray:
        return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(width / 2 / config.cell) + 1,) * 2)

    closed = cv2.morphologyEx(grid.image(cells), cv2.MORPH_CLOSE, disc(config.bridge))
    opened = np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, disc(config.min_width)), np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    area = np.asarray(stats)[:, cv2.CC_STAT_AREA] * config.cell**2
    seen = np.bincount(values_at(np.asarray(labels), cells), minlength=count)
    large = [k for k in range(1, count) if area[k] >= config.min_area]
    return [convex_hull(np.asarray(labels) == k) for k in sorted(large, key=lambda k: -seen[k])]


def _crossings(
    samples: Samples,
    plane: SupportPlane,
    plan: Float[np.ndarray, "n 2"],
    height: Float[np.ndarray, "n"],
    below: Bool[np.ndarray, "n"],
) -> Float[np.ndarray, "k 2"]:
    """Return where the rays of the samples below the plane cross it, in plan coordinates in metres."""
    views = samples.view[below]
    cameras = plane.height_above(samples.centres)[views].astype(np.float32)
    start = (samples.centres @ plane_axes(plane).T).astype(np.float32)[views]
    return start + (cameras / (cameras - height[below]))[:, None] * (plan[below] - start)


def _united(
    grid: PlanGrid,
    parts: list[Int[np.ndarray, "_m 2"]],
    through: Bool[np.ndarray, "r c"],
    config: ExtentConfig,
) -> Int[np.ndarray, "_m 2"]:
    """Return the convex hull of the first part and of those whose gap to it was not seen through."""
    hull = parts[0]
    for part in parts[1:]:
        joint = np.asarray(cv2.convexHull(np.concatenate([hull, part])))[:, 0]
        gap = (grid.filled(joint) > 0) & (grid.filled(hull) == 0) & (grid.filled(part) == 0)
        if through[gap].sum() <= config.max_gap_share * gap.sum():
            hull = joint
    return hull
