"""Whether depth shows the handle of a mug where it is expected.

A turned mug is looked for all round. In a full box the walls and what stands beside the mug explain a handle
in other directions as well as a handle does: what is seen where it is expected was not turned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from perception.depth_cleaning import clean_frame
from perception.detection.geometry import in_image, project
from perception.geometry import transform_points
from perception.inference.handle import body_axis
from perception.metrics import SurfaceSamples, sample_surface
from perception.types import ObjectEstimate, RgbdFrame

BEYOND = 0.010  # [m] beyond the body, from which on points are of the handle
AGREES = 0.008  # [m] between a point and the measured depth
EXPLAINED = 0.006  # [m] from another object's surface
SEEN = 0.6  # least share of the handle's points in view that are measured there
IN_VIEW = 0.1  # least share of its points that nothing occludes, over all views
_SAMPLES, _OTHERS = 20000, 3000  # on the surface of the mug, and of another object
_CELL = 4  # [px] of the image in which points hide those behind them
_BEHIND = 0.004  # [m] behind the nearest point of a cell, from which on a point is hidden


def shows_handle(
    estimate: ObjectEstimate, frames: Sequence[RgbdFrame], others: Sequence[ObjectEstimate] = ()
) -> bool:
    """Return whether the depth of images shows a mug's handle where its pose has it.

    Args:
        estimate: Mug at its pose.
        frames: Images with camera poses.
        others: Objects beside it at their poses; what they explain shows no handle.
    """
    points = sample_surface(estimate.mesh, np.random.default_rng(0), _SAMPLES)
    radius = 0.5 * float(np.ptp(estimate.mesh.vertices[:, 1]))
    is_handle = np.linalg.norm((points - body_axis(estimate))[:, :2], axis=1) > radius + BEYOND
    world = transform_points(estimate.T_world_object, points)
    for other in others:
        surface = SurfaceSamples.of(other.mesh_world, np.random.default_rng(0), _OTHERS)
        is_handle &= surface.distance(world, limit=2 * EXPLAINED) > EXPLAINED
    behind = [_behind(clean_frame(frame), world, is_handle) for frame in frames]
    visible = np.concatenate([np.zeros(0), *behind])
    visible = visible[visible > -AGREES]
    if len(visible) < max(IN_VIEW * is_handle.sum(), 1):
        return False
    return bool(np.mean(visible < AGREES) >= SEEN)


def _behind(
    frame: RgbdFrame, points: Float[np.ndarray, "n 3"], chosen: Bool[np.ndarray, "n"]
) -> Float[np.ndarray, "k"]:
    """Return how far behind each chosen point an image measures something [m]; of points others hide none.

    Args:
        frame: Image without flying pixels.
        points: Points on one surface in the world frame [m], which hide each other.
        chosen: Points to be compared.
    """
    pixels, depth = project(frame, points)
    inside = in_image(frame, pixels, depth)
    pixels, depth = pixels[inside], depth[inside]
    _, cell = np.unique(pixels // _CELL, axis=0, return_inverse=True)
    nearest = np.full(len(depth), np.inf)
    np.minimum.at(nearest, cell.ravel(), depth)
    measured = frame.depth[pixels[:, 1], pixels[:, 0]]
    kept = (depth < nearest[cell.ravel()] + _BEHIND) & chosen[inside] & (measured > 0)
    return (measured - depth)[kept]
