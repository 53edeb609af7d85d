"""Which end of a can is up: no can is wider above than below.

The shape prior reproduces a can that narrows downwards about as well as one that narrows upwards. What tells
them apart is the class: sides of cans are parallel, bulge or narrow upwards. How the radius changes along the
axis is measured on the depth itself, since the prior pulls towards parallel sides:

    r(u) = a + b u + c u^2,  u in [-1/2, 1/2] from bottom to top,

about an axis whose position and tilt are fitted as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation
from perception.types import ObjectEstimate, TriangleMesh

WIDER = 0.16  # difference between the radii at top and bottom, relative to their mean
_ENDS = 0.12  # share of the height at either end, where there are necks, seams and feet
_NEAR = 0.006  # [m] from the estimated radius, within which points belong to the side
_FEWEST = 60  # points in the lower and in the upper third
_MOST = 1500  # points that are fitted
_NOISE = 0.002  # [m] scale of the robust loss


def is_turned_over(estimate: ObjectEstimate, observations: Sequence[ObjectObservation]) -> bool:
    """Return whether an estimate is a can whose measured sides widen upwards, in its own frame."""
    if estimate.category != "can":
        return False
    points = np.concatenate([seen.points_world() for seen in observations])
    points = transform_points(invert(estimate.T_world_object), points)
    return widening(points, estimate.mesh.vertices) > WIDER


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


def widening(points: Float[np.ndarray, "n 3"], vertices: Float[np.ndarray, "v 3"]) -> float:
    """Return the difference between the radii of a round body at top and bottom, relative to their mean.

    Args:
        points: Measured points, in a frame whose z axis is about that of the body, in metres.
        vertices: Vertices of the estimated surface in the same frame, which select the points of the side.

    Returns:
        The difference; 0 where the lower or the upper third of the side was hardly measured.
    """
    low, high = vertices[:, 2].min(), vertices[:, 2].max()
    u = (points[:, 2] - low) / max(high - low, 1e-9) - 0.5
    middle = (vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2
    radius = float(np.ptp(vertices[:, :2], axis=0).mean()) / 2
    away = np.linalg.norm(points[:, :2] - middle, axis=1)
    side = (np.abs(u) < 0.5 - _ENDS) & (away > 0.7 * radius - _NEAR) & (away < radius + _NEAR)
    points, u = points[side], u[side]
    if min((u < -1 / 6).sum(), (u > 1 / 6).sum()) < _FEWEST:
        return 0.0
    chosen = np.linspace(0, len(u) - 1, min(len(u), _MOST)).astype(int)
    plan, u = points[chosen, :2] - middle, u[chosen]

    def residuals(x: Float[np.ndarray, "7"]) -> Float[np.ndarray, "m"]:
        centre, tilt, (a, b, c) = x[:2], x[2:4], x[4:]
        return np.linalg.norm(plan - centre - np.outer(u, tilt), axis=1) - (a + b * u + c * u**2)

    start = np.array([0.0, 0.0, 0.0, 0.0, radius, 0.0, 0.0])
    fitted = least_squares(residuals, start, loss="soft_l1", f_scale=_NOISE, x_scale=0.01).x
    return float(fitted[5] / max(fitted[4], 1e-9))
