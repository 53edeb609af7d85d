"""Contents of bowls and mugs: what lies in the cavity hides the inner surface and must not shape it.

The rim of an upright vessel is a circle at its height. What is seen through it is the floor, which is low, or
the wall, which rises outwards; a surface far above any floor that does not rise outwards is of contents. A
cavity of revolution is equally high all around at one distance from its axis, and no higher nearer to it:
what is, is a thing that stands or lies in it. Their pixels carry no information about the vessel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from perception.geometry import transform_points
from perception.inference.observation import ObjectObservation, pixel_rays
from perception.types import Category, SupportPlane

VESSELS: tuple[Category, ...] = ("mug", "bowl")

_INNER = 0.75  # part of the radius in which the surface seen is judged
_CENTRE = 0.45  # part of the radius that must be seen in part
_OPENING = 0.92  # part of the radius that rays into the cavity pass
_LEVEL: dict[Category, float] = {"mug": 0.3, "bowl": 0.46}  # height above that of floors, in vessel heights
_FULL = 0.95  # height of a surface that cannot be told from the rim or a lid, in vessel heights
_MIN_SHARE = 0.1  # part of the surface in the opening that must lie below it
_ABOVE = 0.08  # what is higher above the rim is a heap, in vessel heights
_NARROW = 0.8  # a ring of highest points narrower than this, relative to the outline, is no rim
_WALL = 0.06  # distance from the outline within which the wall ends, in radii
_UPPER = 0.4  # height from which on points are of the outline, in heights of the highest points
_MOST = 0.9  # part of a mask that can be contents
_MAX_SLOPE = 0.15  # rise of contents towards the wall, in vessel heights per radius
_RINGS = 9  # in which the surface within the opening is compared all around
_AROUND = 24  # sectors of a ring
_LOWER = 0.25  # share of the sectors that show the vessel
_RAISED = (0.012, 0.12)  # how far a thing is above them: in metres, and in vessel heights
_MIN_PIXELS = 40
_MIN_RIM = 30  # points of the rim
_MOST_RIM = 3000  # of them that are used
_SECTORS = 36  # about its centre
_MIN_SECTORS = 18  # with points: half of the rim


@dataclass(frozen=True)
class Rim:
    """Rim of an upright vessel.

    Attributes:
        centre: Centre in the coordinates of the plane, in metres.
        radius: Radius, in metres.
        height: Height above the plane, in metres.
    """

    centre: Float[np.ndarray, "2"]
    radius: float
    height: float


@dataclass(frozen=True)
class _Points:
    """Measured points of a view's mask.

    Attributes:
        v, u: Their pixels.
        plan: (n, 2) coordinates in the plane, in metres.
        height: (n,) heights above the plane, in metres.
        eye: (2,) position of the camera in the plane, in metres.
        eye_height: Height of the camera above the plane, in metres.
    """

    v: np.ndarray
    u: np.ndarray
    plan: Float[np.ndarray, "n 2"]
    height: Float[np.ndarray, "n"]
    eye: Float[np.ndarray, "2"]
    eye_height: float


def without_contents(
    observations: Sequence[ObjectObservation],
    category: Category,
    plane: SupportPlane,
    basis: Float[np.ndarray, "3 3"],
) -> tuple[ObjectObservation, ...]:
    """Return the views of an upright vessel with the pixels of its contents to be ignored.

    Args:
        observations: Views of the vessel.
        category: Its class, one of ``VESSELS``.
        plane: Support plane.
        basis: Two directions in the plane and its normal, as rows.
    """
    points = [_points(seen, plane, basis) for seen in observations]
    rim = find_rim(np.concatenate([p.plan for p in points]), np.concatenate([p.height for p in points]))
    if rim is None:
        return tuple(observations)
    return tuple(_ignoring_contents(seen, p, rim, category) for seen, p in zip(observations, points))


def find_rim(plan: Float[np.ndarray, "n 2"], height: Float[np.ndarray, "n"]) -> Rim | None:
    """Fit a circle to the highest points of a cloud; None if they do not surround it.

    Where contents rise above the rim, the highest points are theirs; the rim is then the upper end of the
    outline.

    Args:
        plan: Coordinates in the plane, in metres.
        height: Heights above the plane, in metres.
    """
    if len(height) < _MIN_RIM:
        return None
    top = float(np.quantile(height, 0.995))
    highest = _ring(plan[height > top - max(0.006, 0.08 * top)])
    outline = _outline(plan[height > _UPPER * top])
    if outline is not None and (highest is None or highest[1] < _NARROW * outline[1]):
        centre, radius = outline
        wall = np.abs(np.linalg.norm(plan - centre, axis=1) / radius - 1.0) < _WALL
        rim = Rim(centre, radius, float(np.quantile(height[wall], 0.95)))
        if _heap(np.array([top]), rim).any():
            return rim
    return None if highest is None else Rim(*highest, top)


def _heap(height: Float[np.ndarray, "n"], rim: Rim) -> Bool[np.ndarray, "n"]:
    """Return which heights are above the rim."""
    return height > (1 + _ABOVE) * rim.height + 0.002


def _outline(plan: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float] | None:
    """Return centre and radius of the circle around a filled disc; None if there is none."""
    inner = _ring(plan)
    if inner is None:
        return None
    centre, radius = inner
    return _ring(plan[np.linalg.norm(plan - centre, axis=1) > _OPENING * radius])


def _ring(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float] | None:
    """Return centre and radius of the circle around points; None if they do not surround it."""
    if len(points) < _MIN_RIM:
        return None
    points = points[:: -(-len(points) // _MOST_RIM)]
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    edge = outermost(points, centre)
    radius = 0.0
    for _ in range(4):  # handles are outliers
        if len(edge) < _MIN_SECTORS:
            return None
        centre, radius = circle(edge)
        edge = outermost(points, centre)
        distance = np.abs(np.linalg.norm(edge - centre, axis=1) - radius)
        edge = edge[distance <= max(2.5 * float(np.median(distance)), 0.002)]
    return (centre, radius) if len(edge) >= _MIN_SECTORS and 0.015 < radius < 0.25 else None


def outermost(points: Float[np.ndarray, "n 2"], centre: Float[np.ndarray, "2"]) -> Float[np.ndarray, "k 2"]:
    """Return a point near the outer edge of each sector about the centre that has points."""
    offset = points - centre
    sector = ((np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    distance = np.linalg.norm(offset, axis=1)
    order = np.argsort(sector + 0.5 * distance / max(distance.max(), 1e-9))  # by sector, then distance
    ends = np.searchsorted(sector[order], np.arange(_SECTORS + 1))
    chosen = [order[low + int(0.9 * (high - low - 1))] for low, high in pairwise(ends) if high > low]
    return points[chosen]


def circle(points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Return centre and radius of the circle of least algebraic distance (Kasa, 1976)."""
    mean = points.mean(axis=0)
    x = points - mean
    A = np.column_stack([2 * x, np.ones(len(x))])
    (a, b, c), *_ = np.linalg.lstsq(A, (x**2).sum(axis=1), rcond=None)
    return mean + np.array([a, b]), float(np.sqrt(max(c + a**2 + b**2, 0.0)))


def _points(seen: ObjectObservation, plane: SupportPlane, basis: Float[np.ndarray, "3 3"]) -> _Points:
    mask = seen.mask & (seen.frame.depth > 0)
    if seen.ignore is not None:
        mask &= ~seen.ignore
    v, u = np.nonzero(mask)
    rays = pixel_rays(seen.frame, u, v)
    world = transform_points(seen.T_world_camera, rays * seen.frame.depth[v, u][:, None].astype(np.float64))
    eye = seen.T_world_camera[:3, 3]
    return _Points(
        v,
        u,
        world @ basis[:2].T,
        plane.height_above(world),
        basis[:2] @ eye,
        float(plane.height_above(eye[None])[0]),
    )


def content_mask(
    plan: Float[np.ndarray, "n 2"],
    height: Float[np.ndarray, "n"],
    eye: Float[np.ndarray, "2"],
    eye_height: float,
    rim: Rim,
    category: Category,
) -> Bool[np.ndarray, "n"]:
    """Return which points of a view are contents of a vessel; none if its cavity looks empty.

    Args:
        plan: Coordinates of the points in the plane, in metres.
        height: Their heights above the plane, in metres.
        eye: Position of the camera in the plane, in metres.
        eye_height: Its height above the plane, in metres.
        rim: Rim of the vessel.
        category: Class of the vessel.
    """
    none = np.zeros(len(height), bool)
    if eye_height <= rim.height:
        return none
    below = np.maximum(eye_height - height, 1e-6)
    crossing = eye + (plan - eye) * ((eye_height - rim.height) / below)[:, None]
    opening = np.linalg.norm(crossing - rim.centre, axis=1) < _OPENING * rim.radius
    rho = np.linalg.norm(plan - rim.centre, axis=1) / rim.radius
    inside = opening & (rho < 1.05)
    inner = inside & (rho < _INNER)
    thing = np.zeros(len(height), bool)
    thing[inner] = raised_on_one_side(plan[inner], height[inner], rim)
    judged = inner & ~thing & (height < _FULL * rim.height - 0.002)
    heap = _heap(height, rim) | thing
    if judged.sum() < max(_MIN_PIXELS, _MIN_SHARE * inner.sum()):
        return heap
    if rho[inner].min() > _CENTRE or np.median(height[judged]) < _LEVEL[category] * rim.height:
        return heap
    design = np.column_stack([rho[judged], np.ones(int(judged.sum()))])
    slope = np.linalg.lstsq(design, height[judged] / rim.height, rcond=None)[0][0]
    if slope > _MAX_SLOPE:
        return heap
    level = float(np.quantile(height[judged], 0.95)) + 0.003
    return heap | inner | (inside & (height < level))


def raised_on_one_side(
    plan: Float[np.ndarray, "n 2"], height: Float[np.ndarray, "n"], rim: Rim
) -> Bool[np.ndarray, "n"]:
    """Return which points within the opening are far above others at their distance from the axis or farther.

    Args:
        plan: Coordinates of the points in the plane, in metres.
        height: Their heights above the plane, in metres.
        rim: Rim of the vessel.
    """
    offset = plan - rim.centre
    ring = np.minimum(np.linalg.norm(offset, axis=1) / (_INNER * rim.radius) * _RINGS, _RINGS - 1).astype(int)
    turn = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) + 0.5
    cell = ring * _AROUND + np.minimum((turn * _AROUND).astype(int), _AROUND - 1)
    total = np.bincount(cell, height, minlength=_RINGS * _AROUND)
    count = np.bincount(cell, minlength=_RINGS * _AROUND)
    mean = np.full(_RINGS * _AROUND, np.nan)
    mean[count > 0] = total[count > 0] / count[count > 0]
    level = np.full(_RINGS, np.inf)
    shown = np.unique(ring)
    level[shown] = np.nanquantile(mean.reshape(_RINGS, _AROUND)[shown], _LOWER, axis=1)
    level = np.minimum.accumulate(level[::-1])[::-1]  # a cavity falls towards its axis
    return height > level[ring] + _RAISED[0] + _RAISED[1] * rim.height


def _ignoring_contents(
    seen: ObjectObservation, points: _Points, rim: Rim, category: Category
) -> ObjectObservation:
    found = content_mask(points.plan, points.height, points.eye, points.eye_height, rim, category)
    if not 0 < found.sum() <= _MOST * len(found):
        return seen
    ignore = np.zeros_like(seen.mask) if seen.ignore is None else seen.ignore.copy()
    ignore[points.v[found], points.u[found]] = True
    return replace(seen, ignore=ignore)
