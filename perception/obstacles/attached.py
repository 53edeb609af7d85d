"""Objects that carry what no class has: the spout of a teapot, the handle of a pan, the grip of a hair dryer.

A body is fitted well by a bottle or a can though it is a part of another thing. What it carries hangs in the
air: the views see the table below it. It is beside the object, not on top of it, and touches nothing else, so
that only the object can hold it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from perception.detection.geometry import in_image, plan_coordinates, points_of, project
from perception.metrics import SurfaceSamples
from perception.obstacles.unexplained import KnownGeometry, raised_pixels
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

_SAMPLES = 6000  # of an object's surface
_BITS = 20  # of a cell's number along each axis
_NEIGHBOURS = 1.8  # distance of cells that touch, at a corner at least, in cells


@dataclass(frozen=True)
class AttachmentConfig:
    """What counts as attached; lengths in metres.

    Attributes:
        margin: Distance from the objects from which on a point belongs to none.
        contact: Distance up to which what begins at the margin touches an object.
        max_height: Largest height above the support.
        cell: Edge length of the cells in which points are connected.
        min_cell_points: Smallest number of points in a cell, over all views.
        min_cells: Smallest number of cells of a part.
        min_views: Smallest number of views that show it.
        open: Smallest share of its plan view below which the support is seen.
        seen_through: Distance from a point to what is measured behind it, from which on it is free.
        lowest: Smallest height of a part above the support: what reaches further down stands on it.
        clear: Height above the support, and distance below the part, of the space that is to be free.
        beside: Smallest distance of its middle from the object's outline in plan view.
        reach: Smallest distance from the object that it reaches: the handle of a mug whose yaw is
            wrong, and caps and rims that a fit misses, reach less.
    """

    margin: float = 0.010
    contact: float = 0.016
    max_height: float = 0.4
    cell: float = 0.005
    min_cell_points: int = 4
    min_cells: int = 30
    min_views: int = 3
    open: float = 0.7
    seen_through: float = 0.010
    lowest: float = 0.02
    clear: float = 0.008
    beside: float = 0.010
    reach: float = 0.035


def carriers_of_parts(
    objects: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: AttachmentConfig = AttachmentConfig(),
) -> set[int]:
    """Return the ids of the objects to which something is attached that belongs to no object.

    Args:
        objects: Object map.
        views: Images without flying pixels and without the robot, with camera poses; fewer than
            ``config.min_views`` show nothing.
        plane: Support plane.
        config: Parameters.
    """
    if len(views) < config.min_views or not objects:
        return set()
    rng = np.random.default_rng(0)
    surfaces = [SurfaceSamples.of(e.mesh_world, rng, _SAMPLES) for e in objects]
    carriers: set[int] = set()
    for part in _parts(views, KnownGeometry.of(objects), plane, config):
        distances = [surface.distance(part) for surface in surfaces]
        touched = [k for k, distance in enumerate(distances) if distance.min() < config.contact]
        if len(touched) != 1 or distances[touched[0]].max() < config.reach:
            continue
        carrier = objects[touched[0]]
        if _is_beside(part, carrier, plane, config) and _hangs(part, views, plane, config):
            carriers.add(carrier.id)
    return carriers


def _parts(
    views: Sequence[RgbdFrame], known: KnownGeometry, plane: SupportPlane, config: AttachmentConfig
) -> Iterator[Float[np.ndarray, "_n 3"]]:
    """Yield the points, one for each cell, of what is beside the objects and ends above the support.

    World frame, in metres.
    """
    points, seen_by = _points(views, plane, config)
    if not len(points):
        return
    index = np.floor((points - points.min(axis=0)) / config.cell).astype(np.int64)
    _, first, number, count = np.unique(
        index @ (1 << np.array([2 * _BITS, _BITS, 0])),
        return_index=True, return_inverse=True, return_counts=True,
    )  # fmt: skip
    cells = index[first]
    means = np.stack([np.bincount(number, p) for p in points.T], axis=1) / count[:, None]
    is_open = (count >= config.min_cell_points) & ~known.explains(means, config.margin)
    part_of = np.full(len(cells), -1)
    part_of[is_open] = _connected(cells[is_open])
    for part in range(int(part_of.max()) + 1):
        own = part_of == part
        if own.sum() < config.min_cells or len(np.unique(seen_by[own[number]])) < config.min_views:
            continue
        if (means[own] @ plane.normal).min() - plane.offset > config.lowest:
            yield means[own]


def _connected(cells: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n"]:
    """Return the number of the connected component of each cell, at whatever distance they are."""
    if not len(cells):
        return np.zeros(0, np.int64)
    pairs = KDTree(cells).query_pairs(_NEIGHBOURS, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(cells), len(cells)))
    return connected_components(links, directed=False)[1]


def _points(
    views: Sequence[RgbdFrame], plane: SupportPlane, config: AttachmentConfig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Return the measured points above the support in the world frame [m], and the view of each."""
    points, seen_by = [np.zeros((0, 3))], [np.zeros(0)]
    for k, view in enumerate(views):
        raised = raised_pixels(view, plane, config.max_height)
        if raised.any():
            points.append(points_of(view, raised))
            seen_by.append(np.full(len(points[-1]), float(k)))
    return np.concatenate(points), np.concatenate(seen_by)


def _is_beside(
    part: Float[np.ndarray, "n 3"], carrier: ObjectEstimate, plane: SupportPlane, config: AttachmentConfig
) -> bool:
    """Return whether the middle of a part is outside the outline of an object in plan view."""
    outline = cv2.convexHull(plan_coordinates(carrier.mesh_world.vertices, plane).astype(np.float32))
    middle = plan_coordinates(part.mean(axis=0)[None], plane)[0]
    return cv2.pointPolygonTest(outline, middle.tolist(), True) < -config.beside


def _hangs(
    part: Float[np.ndarray, "n 3"],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: AttachmentConfig,
) -> bool:
    """Return whether the views see through most of the space between a part and the support."""
    height = part @ plane.normal - plane.offset
    plan = (plan_coordinates(part, plane) / config.cell).astype(np.int64)
    _, column = np.unique(plan, axis=0, return_inverse=True)
    column = column.ravel()
    lowest = np.full(int(column.max()) + 1, np.inf)
    np.minimum.at(lowest, column, height)
    below, owner = [], []
    for point, own in zip(part[height == lowest[column]], column[height == lowest[column]]):
        h = float(lowest[own])
        levels = np.arange(config.clear, h - config.clear, config.cell)
        below.append(point - np.outer(h - levels, plane.normal))
        owner.append(np.full(len(levels), own))
    samples, owners = np.concatenate(below), np.concatenate(owner)
    n_samples = np.bincount(owners, minlength=len(lowest))
    n_free = np.bincount(owners, _seen_through(samples, views, config), minlength=len(lowest))
    return bool(((n_samples > 0) & (n_free >= 0.5 * n_samples)).mean() >= config.open)


def _seen_through(
    points: Float[np.ndarray, "n 3"], views: Sequence[RgbdFrame], config: AttachmentConfig
) -> Bool[np.ndarray, "n"]:
    """Return which points are free: a view measures something behind them."""
    free = np.zeros(len(points), bool)
    for view in views:
        pixels, depth = project(view, points)
        inside = in_image(view, pixels, depth)
        u, v = np.where(inside[:, None], pixels, 0).T
        free |= inside & (view.depth[v, u] > depth + config.seen_through)
    return free
