"""Places on the table that no image has shown, in which an object may stand unseen.

Behind objects, and beyond the borders of few images, something may be hidden. Where that place is wide enough
for an object, the table is looked at once more when all that was seen is done.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float

from perception.detection.geometry import in_image, project
from perception.inference.depth_votes import Region
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

CELL = 0.005  # [m] of the grid of places
HEIGHT = 0.03  # [m] above the table at which they are looked at: an object that is hidden is hidden there
BEFORE = 0.015  # [m] by which what is measured is nearer than a place that it hides, at least
OUTLINE = 0.01  # [m] around a known object, in which nothing else stands
NARROWEST = 0.022  # [m] radius of the thinnest objects


def may_hide_an_object(
    frames: Sequence[RgbdFrame],
    objects: Sequence[ObjectEstimate],
    area: Region,
    plane: SupportPlane = SupportPlane(),
) -> bool:
    """Return whether an object may stand on the table where no image has shown anything.

    Args:
        frames: Images of the table with camera poses.
        objects: Known objects as they stood then.
        area: Ranges of x and y [m] in which objects stand.
        plane: Surface of the table.
    """
    return widest_hidden(frames, objects, area, plane) > NARROWEST


def widest_hidden(
    frames: Sequence[RgbdFrame],
    objects: Sequence[ObjectEstimate],
    area: Region,
    plane: SupportPlane = SupportPlane(),
) -> float:
    """Return the radius [m] of the largest circle of places beside the objects that no image shows.

    Args:
        frames, objects, area, plane: As those of ``may_hide_an_object``.
    """
    (x0, x1), (y0, y1) = area
    x, y = np.meshgrid(np.arange(x0, x1, CELL), np.arange(y0, y1, CELL))
    on_plane = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    on_plane -= plane.height_above(on_plane)[:, None] * plane.normal
    places = on_plane + HEIGHT * plane.normal
    hidden = np.ones(len(places), bool)
    for frame in frames:
        hidden &= ~_shown(frame, places)
    free = hidden.reshape(x.shape).astype(np.uint8)
    for estimate in objects:
        outline = estimate.mesh_world.vertices[:, :2]
        hull = cv2.convexHull((((outline - (x0, y0)) / CELL).round()).astype(np.int32))
        mask = cv2.fillConvexPoly(np.zeros_like(free), hull, 1)
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(OUTLINE / CELL) + 1,) * 2)
        free[cv2.dilate(mask, around) > 0] = 0
    return CELL * float(cv2.distanceTransform(np.pad(free, 1), cv2.DIST_L2, 5).max())


def _shown(frame: RgbdFrame, places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Return the places in an image before which nothing is measured."""
    pixels, depth = project(frame, places)
    shown = in_image(frame, pixels, depth)
    u, v = pixels[shown].T
    measured = frame.depth[v, u]
    shown[shown] = (measured > 0) & (measured > depth[shown] - BEFORE)
    return shown
