"""The next best view: from where a further image would make uncertain objects more certain.

A further image is worth its time if an object may not be what it was taken for, or if even its best grasp may
fail. What an image would show of the objects is estimated from their shapes: every vertex counts with its
variance, if its surface faces the camera and no other object is between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from manipulation.robot import GripperGeometry
from manipulation.types import GraspSet, StandingObject
from manipulation.uncertainty import success_probability
from manipulation.viewpoints import Viewpoint
from perception.surface_geometry import vertex_normals
from perception.types import ObjectEstimate, TriangleMesh

RISK = 0.25  # probability that an object is misjudged, or its best grasp fails, that is worth a further image
BEST_GRASPS = 8  # of an object, of which the most certain one counts
_VERTICES = 400  # of an object that are looked at
_FACING = 0.25  # least cosine between surface normal and line of sight


def risk_of(
    estimate: ObjectEstimate, item: StandingObject, grasps: GraspSet, gripper: GripperGeometry
) -> float:
    """Return the probability that an object is of another class, or that its best grasp fails, in 0..1.

    Objects without a grasp count by their class alone.
    """
    best = [success_probability(item, grasp, gripper) for grasp in grasps.grasps[:BEST_GRASPS]]
    return 1.0 - estimate.score * max(best, default=1.0)


def next_viewpoint(
    objects: Sequence[ObjectEstimate], risks: Mapping[int, float], viewpoints: Sequence[Viewpoint]
) -> Viewpoint | None:
    """Return the viewpoint that shows most of what is uncertain; None if no object is at risk.

    Args:
        objects: Object map; those without standard deviations only hide others.
        risks: Risk of each object by its id.
        viewpoints: Viewpoints without an image so far.
    """
    doubtful = [
        o
        for o in objects
        if risks.get(o.id, 0.0) > RISK and o.surface_sigma is not None and len(o.surface_sigma)
    ]
    if not doubtful or not viewpoints:
        return None
    return max(viewpoints, key=lambda v: sum(risks[o.id] * shown_share(o, v, objects) for o in doubtful))


def shown_share(estimate: ObjectEstimate, viewpoint: Viewpoint, objects: Sequence[ObjectEstimate]) -> float:
    """Return the share of an object's variance that lies on the surface visible from a viewpoint."""
    assert estimate.surface_sigma is not None
    mesh = estimate.mesh_world
    normals = vertex_normals(TriangleMesh(mesh.vertices, mesh.faces))
    every = slice(None, None, max(1, len(mesh.vertices) // _VERTICES))
    points, normals, variance = mesh.vertices[every], normals[every], estimate.surface_sigma[every] ** 2
    camera = viewpoint.camera_pose()[:3, 3]
    rays = camera - points
    seen = (normals * rays).sum(axis=1) > _FACING * np.linalg.norm(rays, axis=1)
    for other in objects:
        if other.id != estimate.id:
            seen &= ~_hides(other, points, camera)
    return float(variance[seen].sum() / max(variance.sum(), 1e-12))


def _hides(
    other: ObjectEstimate, points: Float[np.ndarray, "n 3"], camera: Float[np.ndarray, "3"]
) -> Bool[np.ndarray, "n"]:
    """Return from which points the ellipsoid in another object's bounding box hides the camera."""
    vertices = other.mesh_world.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-3)
    start, ray = (points - middle) / half, (camera - points) / half
    nearest = np.clip(-(start * ray).sum(axis=1) / (ray**2).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(start + nearest[:, None] * ray, axis=1) < 1.0
