"""Which end of a can, or of a bottle without a neck, is up.

The shape prior reproduces a can that narrows downwards about as well as one that narrows upwards. What tells
them apart is the class: sides of cans are parallel, bulge or narrow upwards. A bottle that narrows evenly
towards an end without a neck is a closed cup, which widens upwards. How the radius changes along the
axis is measured on the depth itself, since the prior pulls towards parallel sides:

    r(u) = a + b u + c u^2,  u in [-1/2, 1/2] from bottom to top,

about an axis whose position and tilt are fitted as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation
from perception.types import ObjectEstimate, TriangleMesh

WIDER = 0.16  # difference between the radii at top and bottom, relative to their mean
STRAIGHT = 0.5  # largest |c| of a cone, relative to the mean radius
NECK = 0.8  # largest radius of a neck, relative to that of the cone at the same height
_TOP = 0.1  # share of the height in which a neck is looked for
_FEW = 20  # points there
_ENDS = 0.12  # share of the height at either end, where there are necks, seams and feet
_NEAR = 0.006  # [m] from the estimated radius, within which points belong to the side
_FEWEST = 60  # points in the lower and in the upper third
_MOST = 1500  # points that are fitted
_NOISE = 0.002  # [m] scale of the robust loss


@dataclass(frozen=True)
class SideProfile:
    """How the radius of a round body changes along its axis.

    Attributes:
        radius: a, in the middle, in [m].
        widening: b, the difference between top and bottom, relative to a.
        bulge: c, relative to a; negative where the body is widest in the middle.
    """

    radius: float
    widening: float
    bulge: float


def is_turned_over(estimate: ObjectEstimate, observations: Sequence[ObjectObservation]) -> bool:
    """Return whether an estimate has its lower end up, by its measured sides.

    It is a can that widens upwards, in its own frame, or a lying bottle that narrows evenly towards a top
    without a neck.
    """
    if estimate.category != "can" and (estimate.category, estimate.resting) != ("bottle", "lying"):
        return False
    points = np.concatenate([seen.points_world() for seen in observations])
    points = transform_points(invert(estimate.T_world_object), points)
    profile = side_profile(points, estimate.mesh.vertices)
    if profile is None:
        return False
    if estimate.category == "can":
        return profile.widening > WIDER
    is_cone = profile.widening < -WIDER and abs(profile.bulge) < STRAIGHT
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


def side_profile(points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"]) -> SideProfile | None:
    """Return how the radius of a round body changes along its axis.

    Args:
        points: Measured points, in a frame whose z axis is about that of the body, in metres.
        vertices: Vertices of the estimated surface in the same frame, which select the points of the side.

    Returns:
        The profile; None where the lower or the upper third of the side was hardly measured.
    """
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    u = (points[:, 2] - low) / max(high - low, 1e-9) - 0.5
    middle = (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    radius = float(np.ptp(vertices[:, :2], axis=0).mean()) / 2
    away = np.linalg.norm(points[:, :2] - middle, axis=1)
    side = (np.abs(u) < 0.5 - _ENDS) & (away > 0.7 * radius - _NEAR) & (away < radius + _NEAR)
    points, u = points[side], u[side]
    if min((u < -1 / 6).sum(), (u > 1 / 6).sum()) < _FEWEST:
        return None
    chosen = np.linspace(0, len(u) - 1, min(len(u), _MOST)).astype(int)
    plan, u = points[chosen, :2] - middle, u[chosen]

    def residuals(x: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        centre, tilt, (a, b, c) = x[:2], x[2:4], x[4:]
        return np.linalg.norm(plan - centre - np.outer(u, tilt), axis=1) - (a + b * u + c * u**2)

    start = np.array([0.0, 0.0, 0.0, 0.0, radius, 0.0, 0.0])
    fitted = least_squares(residuals, start, loss="soft_l1", f_scale=_NOISE, x_scale=0.01).x
    a, b, c = fitted[4:].tolist()
    return SideProfile(a, b / max(a, 1e-9), c / max(a, 1e-9))
