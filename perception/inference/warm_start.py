"""Warm start of a fit: an estimate of the same object from fewer images.

A scan takes longer than a fit. Objects are therefore reconstructed from the first images while the arm takes
the others; the fit to all images then starts where the first one ended, at full resolution. An estimate that
the further images contradict, in class, place or direction of the handle, is not used.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.inference.observation import ObjectViews, measured_points
from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose
from perception.types import Category, ObjectEstimate, RestingPose

NEAR = 0.4  # largest distance of the axis from the middle of the measured points, relative to the radius
SAME_YAW = np.deg2rad(20.0)  # largest angle between the handle and the most probable one in all images


def find_warm_start(views: ObjectViews, estimates: Sequence[ObjectEstimate]) -> ObjectEstimate | None:
    """Return the estimate of the object that the views show; None if there is none or it is not certain.

    Args:
        views: Observations of one object, in the world frame.
        estimates: Estimates of all objects from fewer images, in the same frame.
    """
    if not estimates:
        return None
    points = measured_points(views.observations)
    if not len(points):
        return None
    low, high = points.min(axis=0), points.max(axis=0)
    near = [
        estimate
        for estimate in estimates
        if estimate.resting == "upright"
        and estimate.status != "implausible"
        and np.linalg.norm(_middle(estimate) - (low + high) / 2) < NEAR * estimate.radius
    ]
    return near[0] if len(near) == 1 else None


def warm_start(
    estimate: ObjectEstimate | None, category: Category, resting: RestingPose, poses: Sequence[ObjectPose]
) -> FitState | None:
    """Return the state at which the fit of a class in a resting pose starts; None if it starts anew.

    Args:
        estimate: Estimate of the object from fewer images, if there is one.
        category: Class of the fit.
        resting: Resting pose of the fit.
        poses: Initial poses from all images, the most probable first.
    """
    if estimate is None or estimate.category != category or resting != "upright":
        return None
    pose = ObjectPose.of(estimate.T_world_object, estimate.scale)
    if category == "mug" and _angle(pose.rotation[:, 0], poses[0].rotation[:, 0]) > SAME_YAW:
        return None
    return FitState(pose, np.array(estimate.code, dtype=np.float64))


def _middle(estimate: ObjectEstimate) -> Float[np.ndarray, "3"]:
    """Return the middle of the mesh's bounding box in the world frame, in metres."""
    vertices = estimate.mesh_world.vertices
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def _angle(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> float:
    """Return the angle between two unit vectors in radians."""
    return float(np.arccos(np.clip(a @ b, -1.0, 1.0)))
