"""Mugs that are the open end of another thing, such as the shaft of a shoe: their handle is none.

Either the shape takes the rest of the thing for a handle, which is then far too large. Or the rest is left
unexplained: nothing was measured where the handle should be, and a thing of no class touches much of the mug.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from perception.detection.geometry import points_of
from perception.geometry import invert, transform_points
from perception.inference.handle import body_axis
from perception.metrics import SurfaceSamples
from perception.obstacles.unexplained import raised_pixels
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

_SAMPLES = 5000  # of an object's surface


@dataclass(frozen=True)
class HandleConfig:
    """What a handle is; lengths in metres.

    Attributes:
        beyond: Distance from the body from which on a point of the surface belongs to the handle.
        largest: Largest share of the surface that is handle.
        least_views: Smallest number of images that show where the handle is.
        explained: Distance of a measured point from a surface up to which the surface explains it.
        measured: Share of the handle from which on it was measured.
        touching: Distance from the body up to which a measured point touches it.
        around: Angle about the axis, in radians, over which what touches a mug surrounds it.
    """

    beyond: float = 0.008
    largest: float = 0.12
    least_views: int = 4
    explained: float = 0.006
    measured: float = 0.35
    touching: float = 0.014
    around: float = np.radians(120)


def mugs_without_handle(
    objects: Sequence[ObjectEstimate],
    views: Sequence[RgbdFrame],
    plane: SupportPlane,
    config: HandleConfig = HandleConfig(),
) -> set[int]:
    """Return the ids of the mugs whose handle is none.

    Args:
        objects: Object map.
        views: Images without flying pixels and without the robot, with camera poses.
        plane: Support plane.
        config: What a handle is.
    """
    mugs = [e for e in objects if e.category == "mug"]
    if not mugs:
        return set()
    rng = np.random.default_rng(0)
    surfaces = {e.id: SurfaceSamples.of(e.mesh_world, rng, _SAMPLES) for e in objects}
    handles = {e.id: _is_handle(e, surfaces[e.id].points, config) for e in mugs}
    found = {e.id for e in mugs if handles[e.id].mean() > config.largest}
    upright = [e for e in mugs if e.id not in found and e.resting == "upright"]
    upright = [e for e in upright if e.n_views >= config.least_views and handles[e.id].any()]
    points = np.concatenate([np.zeros((0, 3)), *(_raised(view, plane) for view in views if upright)])
    for mug in upright:
        reach = float(np.linalg.norm(np.abs(mug.mesh.vertices).max(axis=0))) + config.touching
        near = points[np.linalg.norm(points - mug.T_world_object[:3, 3], axis=1) < reach]
        handle = surfaces[mug.id].points[handles[mug.id]]
        if not len(near) or _measured(handle, near, config) >= config.measured:
            continue
        distances = [surface.distance(near, limit=2 * config.beyond) for surface in surfaces.values()]
        if _angle_around(mug, near[np.min(distances, axis=0) > config.beyond], config) >= config.around:
            found.add(mug.id)
    return found


def _measured(
    handle: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m 3"], config: HandleConfig
) -> float:
    """Return the share of a handle's surface at which there are measured points."""
    distance = KDTree(points).query(handle, distance_upper_bound=2 * config.explained)[0]
    return float((distance < config.explained).mean())


def _is_handle(
    mug: ObjectEstimate, points: Float[np.ndarray, "n 3"], config: HandleConfig
) -> Bool[np.ndarray, "n"]:
    """Return which world points are farther from a mug's axis than its body is."""
    return np.linalg.norm(_about_axis(mug, points)[:, :2], axis=1) > mug.radius + config.beyond


def _angle_around(mug: ObjectEstimate, points: Float[np.ndarray, "n 3"], config: HandleConfig) -> float:
    """Return the angle over which world points touch the side of a mug, in radians."""
    local = _about_axis(mug, points)
    low, high = mug.mesh.vertices[:, 2].min(), mug.mesh.vertices[:, 2].max()
    distance = np.linalg.norm(local[:, :2], axis=1)
    beside = (distance > mug.radius) & (distance < mug.radius + config.touching)
    beside &= (local[:, 2] > low + config.touching) & (local[:, 2] < high)
    bins = np.unique(np.floor(np.degrees(np.arctan2(local[beside, 1], local[beside, 0])) / 10))
    return float(np.radians(10 * len(bins)))


def _about_axis(mug: ObjectEstimate, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return world points in the mug's frame, with the origin moved to the axis of its body."""
    return transform_points(invert(mug.T_world_object), points) - body_axis(mug)


def _raised(view: RgbdFrame, plane: SupportPlane) -> Float[np.ndarray, "n 3"]:
    """Return the measured points above the support in the world frame, in metres."""
    raised = raised_pixels(view, plane)
    return points_of(view, raised) if raised.any() else np.zeros((0, 3))
