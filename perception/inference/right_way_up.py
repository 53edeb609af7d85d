"""Which end of a can, or of a bottle without a neck, is up.

The shape prior reproduces a can that narrows downwards about as well as one that narrows upwards. What tells
them apart is the class: sides of cans are parallel, bulge or narrow upwards. A bottle that narrows evenly
towards an end without a neck is a closed cup, which widens upwards. How the radius changes along the
axis is measured on the depth itself, since the prior pulls towards parallel sides:

    r(u) = a + b u + c u^2,  u in [-1/2, 1/2] from bottom to top,

about an axis whose position is fitted as well, and of lying objects its tilt: seen from one side, a cone that
stands looks like a cylinder that leans, which nothing does. Of a standing object of which only a part is in
view, c is taken for 0: a can that bulges, or is narrow in the middle, is the same either way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation, measured_points
from perception.types import ObjectEstimate, TriangleMesh

WIDER = 0.16  # difference between the radii at top and bottom, relative to their mean, of what lies
STANDING_WIDER = 0.13  # of what stands, whose axis is known
CLEARLY_WIDER = 0.2  # of what stands and may well be a bottle
STRAIGHT = 0.5  # largest |c| of a cone, relative to the mean radius
EVEN = 0.05  # largest unevenness of a cone: a bottle with a wide neck narrows between two cylinders
NECK = 0.8  # largest radius of a neck, relative to that of the cone at the same height
LEAST_RADIUS, LARGEST_RADIUS = (
    0.75,
    1.25,
)  # of a profile in its middle, relative to the estimate's largest one
_TOP = 0.1  # share of the height in which a neck is looked for
_FEW = 20  # points there
_ENDS = 0.12  # share of the height at either end, where there are necks, seams and feet
_NEAR = 0.006  # [m] from the estimated radius, within which points belong to the side
_OVERHANG = 0.2  # share of the height by which the estimate may reach beyond a measured lid
_LID = 0.6  # share of the radius within which measured points are on a lid
_FEWEST = 60  # points in the lower and in the upper third
_PART, _FEWEST_OF_PART = 0.35, 40  # share of the height that a part of a side has, and points in its thirds
_SECTIONS = 8  # along the axis, in which the evenness of a side is judged
_MOST = 1500  # points that are fitted
_NOISE = 0.002  # [m] scale of the robust loss


@dataclass(frozen=True)
class SideProfile:
    """How the radius of a round body changes along its axis.

    Attributes:
        radius: a, in the middle, in [m].
        widening: b, the difference between top and bottom, relative to a.
        bulge: c, relative to a; negative where the body is widest in the middle.
        unevenness: Largest deviation of the measured radius from the profile, relative to a.
        deviation: Standard deviation of b, relative to a.
    """

    radius: float
    widening: float
    bulge: float
    unevenness: float
    deviation: float


def is_turned_over(
    estimate: ObjectEstimate, observations: Sequence[ObjectObservation], is_doubtful: bool = False
) -> bool:
    """Return whether an estimate has its lower end up, by its measured sides.

    It is a can that widens upwards, in its own frame, or a lying bottle that narrows evenly towards a top
    without a neck.

    Args:
        estimate: The estimate.
        observations: Views of the object.
        is_doubtful: Whether a standing can may well be a bottle, and has to widen more.
    """
    if estimate.category != "can" and (estimate.category, estimate.resting) != ("bottle", "lying"):
        return False
    points = measured_points(observations)
    points = transform_points(invert(estimate.T_world_object), points)
    lies = estimate.resting == "lying"
    profile = side_profile(points, estimate.mesh.vertices, may_tilt=lies)
    if profile is None:
        return False
    if estimate.category == "can":
        standing = CLEARLY_WIDER if is_doubtful else STANDING_WIDER
        return profile.widening - profile.deviation > (WIDER if lies else standing)
    is_even = abs(profile.bulge) < STRAIGHT and profile.unevenness < EVEN
    is_cone = profile.widening < -WIDER and is_even
    return is_cone and not _has_neck(points, estimate.mesh.vertices, profile)


def _has_neck(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], profile: SideProfile
) -> bool:
    """Return whether a cone ends in a neck, or its end was hardly measured."""
    high, height = vertices[:, 2].max(), np.ptp(vertices[:, 2])
    middle = (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    away = np.linalg.norm(points[:, :2] - middle, axis=1)
    cone = profile.radius * (1 + (0.5 - _TOP / 2) * profile.widening)
    at_end = (np.abs(points[:, 2] - high) < _TOP * height) & (away < 1.2 * cone + _NEAR)
    return bool(at_end.sum() < _FEW or np.percentile(away[at_end], 80) < NECK * cone)


def turned_over(estimate: ObjectEstimate, other: ObjectEstimate) -> ObjectEstimate:
    """Return an estimate with its axis reversed, the code from a fit that way round.

    Surface, score and status remain: the prior, which hardly contains such a can, explains it less well.
    """
    turn = np.diag([1.0, -1.0, -1.0, 1.0])
    mesh = TriangleMesh(estimate.mesh.vertices * np.diag(turn)[:3], estimate.mesh.faces)
    return replace(
        other,
        T_world_object=estimate.T_world_object @ turn,
        mesh=mesh,
        surface_sigma=estimate.surface_sigma,
        score=estimate.score,
        residual=estimate.residual,
        status=estimate.status,
    )


def side_profile(
    points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"], may_tilt: bool
) -> SideProfile | None:
    """Return how the radius of a round body changes along its axis.

    Args:
        points: Measured points, in a frame whose z axis is about that of the body, in metres.
        vertices: Vertices of the estimated surface in the same frame, which select the points of the side.
        may_tilt: Whether the axis may deviate from z.

    Returns:
        The profile; None where the lower or the upper third of the side was hardly measured, of what stands
        too little of it, or where the points, all on one side, do not determine the radius.
    """
    middle = (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    radius = float(np.ptp(vertices[:, :2], axis=0).mean()) / 2
    away = np.linalg.norm(points[:, :2] - middle, axis=1)
    low, high = _ends(vertices[:, 2], points[away < _LID * radius, 2])
    u = (points[:, 2] - low) / max(high - low, 1e-9) - 0.5
    side = (np.abs(u) < 0.5 - _ENDS) & (away > 0.7 * radius - _NEAR) & (away < radius + _NEAR)
    points, u = points[side], u[side]
    lower, upper = np.quantile([vertices[:, 2].min(), vertices[:, 2].max()], (1 / 3, 2 / 3))
    is_whole = min((points[:, 2] < lower).sum(), (points[:, 2] > upper).sum()) >= _FEWEST
    if not is_whole and (may_tilt or not _shows_part(u)):
        return None
    chosen = np.linspace(0, len(u) - 1, min(len(u), _MOST)).astype(int)
    plan, u = points[chosen, :2] - middle, u[chosen]

    def residuals(x: Float[np.ndarray, "k"]) -> Float[np.ndarray, "m"]:
        (centre, (a, b)), (c, *tilt) = np.split(x[:4], 2), x[4:] if is_whole else [0.0]
        axis = centre + np.outer(u, tilt if may_tilt else np.zeros(2))
        return np.linalg.norm(plan - axis, axis=1) - (a + b * u + c * u**2)

    start = np.array([0.0, 0.0, radius, 0.0, *([0.0] if is_whole else []), *([0.0, 0.0] if may_tilt else [])])
    fit = least_squares(residuals, start, loss="soft_l1", f_scale=_NOISE, x_scale=0.01)
    a, b, c = float(fit.x[2]), float(fit.x[3]), float(fit.x[4]) if is_whole else 0.0
    if not LEAST_RADIUS < a / radius < LARGEST_RADIUS:
        return None
    covariance = _NOISE**2 * np.linalg.pinv(fit.jac.T @ fit.jac)
    relative = b, c, _unevenness(u, residuals(fit.x)), float(np.sqrt(covariance[3, 3]))
    return SideProfile(a, *(value / max(a, 1e-9) for value in relative))


def _shows_part(u: Float[np.ndarray, "n"]) -> bool:
    """Return whether points on a side spread along a part of the axis that tells how the radius changes."""
    if len(u) < _FEWEST_OF_PART:
        return False
    low, high = np.quantile(u, (0.03, 0.97))
    third = (high - low) / 3
    ends = (u < low + third).sum(), (u > high - third).sum()
    return bool(high - low > _PART and min(ends) >= _FEWEST_OF_PART)


def _unevenness(u: Float[np.ndarray, "n"], residuals: Float[np.ndarray, "n"]) -> float:
    """Return the largest median of the residuals of a profile [m] in sections along the axis."""
    section = np.floor((u + 0.5) * _SECTIONS).astype(int)
    medians = [
        abs(float(np.median(residuals[section == k])))
        for k in range(_SECTIONS)
        if (section == k).sum() >= _FEW
    ]
    return max(medians, default=0.0)


def _ends(estimated: Float[np.ndarray, "v"], inside: Float[np.ndarray, "n"]) -> tuple[float, float]:
    """Return both ends along the axis: those of the estimate, or a measured lid a little before one.

    A lid below the top of a shape that is too high would count as a part of its side.

    Args:
        estimated: Positions of the estimated surface along the axis.
        inside: Positions of the measured points near the axis, which are on a lid.
    """
    low, high = float(estimated.min()), float(estimated.max())
    most = _OVERHANG * (high - low)
    below, above = inside[inside < low + most], inside[inside > high - most]
    if len(below) >= _FEWEST:
        low = max(low, float(np.median(below)))
    if len(above) >= _FEWEST:
        high = min(high, float(np.median(above)))
    return low, high
