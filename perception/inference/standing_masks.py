"""Masks of objects whose place is known: the measured points around their axes, above what they stand on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from jaxtyping import Bool, Float

from perception.metrics import SurfaceSamples
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

PIXELS = 1500  # of a mask, at least
MARGINS = (0.004, 0.02)  # [m] beyond the radius and over the top of the estimate
_FLOOR = 0.006  # [m] above the plane, from which on points are not of it


def standing_masks(
    estimate: ObjectEstimate,
    views: Sequence[RgbdFrame],
    points: Sequence[Float[np.ndarray, "_n 3"]],
    plane: SupportPlane,
    surfaces: Mapping[int, SurfaceSamples] = MappingProxyType({}),
    margins: tuple[float, float] = MARGINS,
) -> dict[int, Bool[np.ndarray, "H W"]]:
    """Return the pixels around an estimate's axis and above its support by the index of the view.

    Args:
        estimate: Object at its pose.
        views: Images.
        points: Their measured points in the world frame, in metres, in the order of the pixels.
        plane: Support plane.
        surfaces: Surfaces of the object and of those beside it in the world frame, by id: points that are
            nearer to another one are left out.
        margins: How far beyond the estimate's radius and over its top points are of it, in metres.
    """
    vertices, axis = estimate.mesh_world.vertices, estimate.T_world_object[:2, 3]
    radius = float(np.linalg.norm(vertices[:, :2] - axis, axis=1).max())
    top = float(plane.height_above(vertices).max())
    beside = [surface for id, surface in surfaces.items() if id != estimate.id]
    masks = {}
    for k, (view, seen) in enumerate(zip(views, points, strict=True)):
        height = plane.height_above(seen)
        around = (
            (np.linalg.norm(seen[:, :2] - axis, axis=1) < radius + margins[0])
            & (height > _FLOOR)
            & (height < top + margins[1])
        )
        if beside:
            near = seen[around]
            nearest = np.min([surface.distance(near) for surface in beside], axis=0)
            around[around] = surfaces[estimate.id].distance(near) <= nearest
        mask = np.zeros(view.depth.shape, dtype=bool)
        mask[view.depth > 0] = around
        if mask.sum() >= PIXELS:
            masks[k] = mask
    return masks
