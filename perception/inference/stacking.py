"""Objects that rest on other objects: which rests on what, and how far one is above or inside the other.

An object whose measured points all lie clearly above the plane, over the outline of another one, is taken to
rest on it. It is fitted again with the support plane raised to the height of the contact, so that the same
prior holds: its lowest part touches what is below it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.inference.contents import VESSELS
from perception.inference.explanation import unexplained
from perception.inference.fit_config import FitConfig
from perception.inference.initialise import plane_basis
from perception.inference.observation import ObjectViews, measured_points
from perception.types import ObjectEstimate, SupportPlane, TriangleMesh

Fit = Callable[[ObjectViews, SupportPlane, FitConfig], ObjectEstimate]

LEAST_BASE = 0.012  # [m] height over the plane of the lowest measured points of an object on another one
_HIGHER = 0.008  # [m] by which the top of the upper object is above that of the lower one, at least
_CELL = 0.002  # [m] of the height maps whose difference is the gap
FREE = 0.1  # [m] standard deviation of the height of the lowest part before the contact is known
WORSE = 0.3  # by which the score of a fit on the contact may be below that of the fit at any height
_OVERLAP = 0.008  # [m] by which two objects may overlap: estimated rims are thicker than real ones
_SHARES = (0.55, 1.4)  # of a height after and before, at least and at most
_DEEP = 0.7  # height of a base relative to the contact, below which it is far inside the object below
_HIDDEN = 0.05  # by which the unexplained share may grow with another height of a hidden top
_SUNK = 0.005  # [m] by which the lowest measured points may be below the base
_TOPPLING = 0.005  # [m] beside the other object's outline that the middle of an object on it may seem to be
_LEANING = 0.3  # [rad] standard deviation of the tilt of an object in a vessel
_MOST_LEANING = math.radians(40)
_DOUBTFUL, _CLEARLY = 0.05, 0.6  # unexplained share of a poor fit, and largest ratio of that of a better one
# Ratio of the residuals, and difference of the scores, from which on an object in a vessel leans although its
# points are about explained without tilt. In 8 scans it was 0.66 to 0.78 for what leaned by 15 degrees and
# more, 0.95 and more for what stood.
_CLOSER, _AS_GOOD = 0.85, 0.02
BELOW = 0.01  # [m] below the lowest measured points, where the foot of an object on something hidden may be
_VIEWS = 2  # in which an object is measured
_CENTRAL = (
    0.25  # share of the points about the centre of the upper object under which the lower one is looked up
)


@dataclass(frozen=True)
class MeasuredExtent:
    """Measured points of an object over its support plane.

    Attributes:
        plan: (n, 2) coordinates in the plane, in metres.
        base: Height of the lowest points, in metres.
        top: Height of the highest points, in metres.
    """

    plan: Float[np.ndarray, "n 2"]
    base: float
    top: float

    @staticmethod
    def of(views: ObjectViews, plane: SupportPlane) -> MeasuredExtent:
        """Measure the points of the largest views."""
        clouds = [seen.points_world(erode=2) for seen in views.observations[:_VIEWS]]
        points = np.concatenate(clouds)
        if not len(points):
            return MeasuredExtent(np.zeros((0, 2)), 0.0, 0.0)
        base = min(float(np.quantile(plane.height_above(cloud), 0.03)) for cloud in clouds if len(cloud))
        top = float(np.quantile(plane.height_above(points), 0.99))
        return MeasuredExtent(points @ plane_basis(plane)[:2].T, base, top)

    @property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Centre of the bounding box in the plane, in metres."""
        return (self.plan.min(axis=0) + self.plan.max(axis=0)) / 2


def find_stacks(
    instances: Sequence[ObjectViews], plane_of: Mapping[int | None, SupportPlane]
) -> dict[int, int]:
    """Return for each object that rests on another one the id of that one, the lowest objects first.

    Args:
        instances: Objects.
        plane_of: Support plane of each object.
    """
    below: dict[int, int] = {}
    for plane in {id(plane_of[views.id]): plane_of[views.id] for views in instances}.values():
        there = [views for views in instances if plane_of[views.id] is plane]
        if len(there) > 1:
            below |= stacked({views.id: MeasuredExtent.of(views, plane) for views in there})
    return below


def stacked(extents: Mapping[int, MeasuredExtent]) -> dict[int, int]:
    """Return the same for objects over a common plane, from their measured points by id."""
    below = {}
    for upper, seen in sorted(extents.items(), key=lambda item: item[1].base):
        if seen.base < LEAST_BASE:
            continue
        under = [
            key for key, other in extents.items()
            if key != upper and other.top < seen.top - _HIGHER and other.base < seen.base
            and _covers(other.plan, seen.centre)
        ]  # fmt: skip
        if under:
            below[upper] = max(under, key=lambda key: extents[key].top)
    return below


def rest_on(
    views: ObjectViews, lower: ObjectEstimate, plane: SupportPlane, config: FitConfig, fit: Fit
) -> ObjectEstimate:
    """Return the estimate of an object that rests on another one: touching it, and not inside it.

    Where that clearly contradicts the evidence, because the shape of the lower object is uncertain, the
    estimate is that of the fit at any height: where the fit is far worse, or measured points are below the
    contact, as the floor of a bowl in a mug whose rim it hides. On a can, whose top it hides, that fit only
    has to be about as good, and not far inside the can. An object whose middle is not over the other one,
    which hides its foot, stands on the plane, and so does one above an object on its side: nothing stands on
    what can roll.

    Args:
        views: Observations of the upper object.
        lower: Estimate of the object below.
        plane: Support plane of the object below.
        config: Settings of the fits.
        fit: Fits the upper object, given the plane that it stands on.

    Raises:
        PerceptionError: A fit fails.
    """
    seen = MeasuredExtent.of(views, plane)
    under = _height_under(seen, lower.mesh_world, plane)
    if under is None or lower.resting == "lying":
        return fit(views, plane, config)
    start = raised(plane, under)
    free = replace(config, noise=replace(config.noise, support_sigma=FREE))
    points = measured_points(views.observations, erode=2)
    floating = fit(views, start, free)
    may_be_higher = seen.base - BELOW > under + _HIGHER  # the lower object may be taller than what is seen
    if may_be_higher and unexplained(points, [floating]) >= _DOUBTFUL:
        higher = fit(views, raised(plane, seen.base - BELOW), free)
        floating = higher if _explains_more(points, higher, floating) else floating
    first = floating.mesh_world
    clearance = gap(first, lower.mesh_world, plane)
    if clearance is None or not _is_over(first, lower.mesh_world, plane):
        return fit(views, plane, config)
    lowest = float(plane.height_above(first.vertices).min())
    contact = lowest - clearance
    touching = fit(views, raised(plane, contact), config)
    contradicted = touching.score < floating.score - WORSE or seen.base < contact - _SUNK
    if lower.category not in VESSELS:  # its top is hidden
        is_possible = lowest > _DEEP * contact
        contradicted |= is_possible and floating.score >= touching.score - _AS_GOOD
        contradicted |= _explains_more(points, floating, touching)
    best = floating if contradicted else touching
    rim = float(plane.height_above(lower.mesh_world.vertices).max())
    if lower.category in VESSELS and min(lowest, contact) < rim - _HIGHER:
        best = _leaning(views, points, best, start, config, fit) or best
    return replace(best, rests_on=lower.id)


def _explains_more(points: Float[np.ndarray, "n 3"], one: ObjectEstimate, other: ObjectEstimate) -> bool:
    """Return whether an estimate explains the measured points clearly better than a poor other one."""
    before = unexplained(points, [other])
    return before >= _DOUBTFUL and unexplained(points, [one]) < _CLEARLY * before


def _leaning(
    views: ObjectViews,
    points: Float[np.ndarray, "n 3"],
    upright: ObjectEstimate,
    plane: SupportPlane,
    config: FitConfig,
    fit: Fit,
) -> ObjectEstimate | None:
    """Return the estimate of an object that leans on the wall of a vessel; None if it does not.

    It may touch the vessel anywhere, so that neither tilt nor height are known.

    Args:
        views: Observations of the object.
        points: Its measured points in the world frame, in metres.
        upright: Its estimate without tilt.
        plane: Plane at the height of the cavity below it.
        config: Settings of the fits.
        fit: Fits the object, given the plane that it stands on.
    """
    noise = replace(config.noise, tilt_sigma=_LEANING, support_sigma=FREE)
    try:
        leaning = fit(views, plane, replace(config, noise=noise, max_tilt=_MOST_LEANING))
    except PerceptionError:
        return None
    is_closer = leaning.residual < _CLOSER * upright.residual and leaning.score >= upright.score - _AS_GOOD
    return leaning if is_closer or _explains_more(points, leaning, upright) else None


def gap(upper: TriangleMesh, lower: TriangleMesh, plane: SupportPlane) -> float | None:
    """Return how far one object can be lowered until it touches another one, in metres.

    Negative where it is inside the other one; None if no part of it is above the other one.

    Args:
        upper: Mesh of the upper object in the world frame, in metres.
        lower: Mesh of the lower object in the world frame, in metres.
        plane: Plane whose normal is the vertical.
    """
    cells, low = _extreme_heights(_samples(upper), plane, np.minimum)
    others, high = _extreme_heights(_samples(lower), plane, np.maximum)
    _, at, there = np.intersect1d(cells, others, return_indices=True)
    return float((low[at] - high[there]).min()) if len(at) else None


def ending_below(
    lower: ObjectEstimate, upper: ObjectEstimate, plane: SupportPlane, points: Float[np.ndarray, "n 3"]
) -> ObjectEstimate:
    """Return an upright object that ends where one on it, estimated at any height, begins.

    What is on it hides its top, which the prior alone estimates. A vessel, whose rim is seen, may end below.
    It is returned as it is if both hardly overlap, or by far too much, or if its measured points contradict:
    the handle of a mug may be estimated through the rim of the bowl that it is in.

    Args:
        lower: Estimate of the object below.
        upper: Estimate of the object on it.
        plane: Support plane of the object below.
        points: Measured points of the object below in the world frame, in metres.
    """
    if lower.resting != "upright":
        return lower
    cells, low = _extreme_heights(_samples(upper.mesh_world), plane, np.minimum)
    others, high = _extreme_heights(_samples(lower.mesh_world), plane, np.maximum)
    _, at, there = np.intersect1d(cells, others, return_indices=True)
    if not len(at):
        return lower
    before = np.maximum(high[there], _CELL)
    share = min(float(((low[at] + _OVERLAP) / before).min()), 1.0)
    if share == 1.0 and lower.category not in VESSELS:
        share = max(float((low[at] / before).min()), 1.0)
    if share == 1.0 or not _SHARES[0] < share < _SHARES[1]:
        return lower
    T = lower.T_world_object.copy()
    T[:3, 3] += (share - 1.0) * float(plane.height_above(T[None, :3, 3])[0]) * plane.normal
    z = np.array([1.0, 1.0, share])
    mesh = TriangleMesh(lower.mesh.vertices * z, lower.mesh.faces)
    ended = replace(lower, T_world_object=T, scale=lower.scale * z, mesh=mesh)
    # A handle is scaled with the rest, and is too low then: only points above the new top contradict.
    top = plane.height_above(ended.mesh_world.vertices).max()
    above = points[plane.height_above(points) > top]
    more = unexplained(above, [ended, upper]) - unexplained(above, [lower, upper])
    return lower if more * len(above) > _HIDDEN * len(points) else ended


def raised(plane: SupportPlane, height: float) -> SupportPlane:
    """Return the plane moved upwards by a height in metres."""
    return replace(plane, offset=plane.offset + height)


def _is_over(upper: TriangleMesh, lower: TriangleMesh, plane: SupportPlane) -> bool:
    """Return whether the middle of one object is over the outline of another one: else it would topple."""
    basis = plane_basis(plane)[:2].T
    return _covers(lower.vertices @ basis, upper.vertices.mean(axis=0) @ basis, _TOPPLING)


def _covers(plan: Float[np.ndarray, "n 2"], point: Float[np.ndarray, "2"], margin: float = 0.0) -> bool:
    """Return whether a point is in the convex hull of others, or at most ``margin`` metres beside it."""
    if len(plan) < 3:
        return False
    hull = cv2.convexHull((1000 * plan).astype(np.float32))
    return cv2.pointPolygonTest(hull, (1000 * point).tolist(), True) >= -1000 * margin


def _height_under(seen: MeasuredExtent, lower: TriangleMesh, plane: SupportPlane) -> float | None:
    """Return the height of the lower object below the centre of the upper one, in metres; None beside it."""
    reach = _CENTRAL * float(np.ptp(seen.plan, axis=0).max())
    points = _samples(lower)
    near = np.linalg.norm(points @ plane_basis(plane)[:2].T - seen.centre, axis=1) < max(reach, 0.01)
    if not near.any():
        return None
    _, top = _extreme_heights(points[near], plane, np.maximum)
    return max(float(np.median(top)), 0.0)


def _samples(mesh: TriangleMesh) -> Float[np.ndarray, "n 3"]:
    """Return points on the surface at most a cell apart."""
    import trimesh  # slow to import

    return trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=_CELL, max_iter=20)[0]


def _extreme_heights(
    points: Float[np.ndarray, "n 3"], plane: SupportPlane, extreme: np.ufunc
) -> tuple[np.ndarray, np.ndarray]:
    """Return the occupied cells of a grid in the plane and their extreme heights, in metres."""
    cell = np.floor(points @ plane_basis(plane)[:2].T / _CELL).astype(np.int64)
    keys, inverse = np.unique(cell[:, 0] * 2**32 + cell[:, 1], return_inverse=True)
    heights = np.full(len(keys), -np.inf if extreme is np.maximum else np.inf)
    extreme.at(heights, inverse, plane.height_above(points))
    return keys, heights
