"""Uncertain shapes in planning: wider clearances, and grasps ranked by the probability that they succeed.

Perception gives every vertex of a shape a standard deviation along its normal. What several images have shown
is known to a millimetre, which the ordinary clearances cover; the hidden side of what one image has shown, to
several. Without standard deviations, shapes are taken as they are.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from manipulation.robot import GripperGeometry
from manipulation.types import Grasp, StandingObject
from perception.surface_geometry import vertex_normals
from perception.types import TriangleMesh

SIGMAS = 2.0  # standard deviations within which a surface is assumed: 98 % on one side
COVERED = 0.008  # [m] of them that the ordinary clearances and gaps cover
MOST = 0.010  # [m] by which a shape is widened; thin parts, such as the end of a handle, have outliers
SURE = 0.98  # probability of success from which on grasps are ranked by their score alone
WEIGHT = 2.0  # of the probability that a grasp lacks, relative to the score
_BESIDE = 0.004  # [m] around a pad, within which vertices are at its contact
_CERTAIN = 3.0  # standard deviations of gap from which on every grasp is sure


def outer_vertices(item: StandingObject) -> Float[np.ndarray, "v 3"]:
    """Return the vertices [m] of a shape that contains the true one, in the stand frame.

    Vertices are displaced along their normals by what the ordinary clearances do not cover, not downwards.
    """
    if not len(item.sigma):
        return item.vertices
    excess = np.clip(SIGMAS * item.sigma - COVERED, 0.0, MOST)
    if not excess.any():
        return item.vertices
    moved = item.vertices + excess[:, None] * vertex_normals(TriangleMesh(item.vertices, item.faces))
    moved[:, 2] = np.maximum(moved[:, 2], item.vertices[:, 2].min())
    return moved


def success_probability(item: StandingObject, grasp: Grasp, gripper: GripperGeometry) -> float:
    """Return the probability that the open fingers reach a grasp without touching the object.

    The product over both pads of Phi(gap / sigma): the gap between pad and surface before closing, and the
    standard deviation (root mean square) of the surface where the finger passes.
    """
    if not len(item.sigma):
        return 1.0
    T = grasp.T_stand_tcp
    across, closing, approach = ((item.vertices - T[:3, 3]) @ T[:3, :3]).T
    passed = (np.abs(across) < gripper.pad_half_height + _BESIDE) & (approach < gripper.tip)
    passed &= np.abs(closing) < 0.5 * grasp.held_width + _BESIDE
    probability = 1.0
    for gap, side in zip(_gaps(grasp), (closing < 0, closing > 0), strict=True):
        at = passed & side
        sigma = item.sigma[at if at.any() else slice(None)]
        probability *= float(ndtr(gap / max(float(np.sqrt(np.mean(sigma**2))), 1e-6)))
    return probability


def ranked(item: StandingObject, grasps: tuple[Grasp, ...], gripper: GripperGeometry) -> tuple[Grasp, ...]:
    """Return grasps in descending order of their score, less what their probability of success lacks."""
    if not len(item.sigma) or not grasps:
        return grasps
    if min(min(_gaps(grasp)) for grasp in grasps) > _CERTAIN * float(item.sigma.max()):
        return grasps
    lacking = [max(SURE - success_probability(item, grasp, gripper), 0.0) for grasp in grasps]
    value = [grasp.score - WEIGHT * share for grasp, share in zip(grasps, lacking, strict=True)]
    return tuple(grasps[k] for k in sorted(range(len(grasps)), key=lambda k: -value[k]))


def _gaps(grasp: Grasp) -> tuple[float, float]:
    """Return the distances [m] of the pads on the sides of -y and +y from the surface before they close."""
    room = grasp.opening - grasp.held_width
    return (grasp.stand_off, room - grasp.stand_off) if grasp.stand_off > 0 else (room / 2, room / 2)
