"""Whether a thing of no class is still where it was: one image may show what was behind it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.detection.geometry import project
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import RgbdFrame, SupportPlane

BEHIND = 0.015  # [m] from a point of the thing to what is seen behind it, from which on it is not there
THICK = 0.08  # [m] by which a surface of the thing itself may be nearer to the camera than a point in it
LEAST_HEIGHT = 0.025  # [m] above the table: nearer to it, what is behind a point is hardly farther away
LEAST_SHOWN = 0.15  # share of the points that the image must show
_SHRUNK = (0.25, 0.5, 0.75)  # of the vertices towards the middle of their piece


def seen_through(
    thing: PerceivedObstacle, frame: RgbdFrame, table: SupportPlane = SupportPlane()
) -> float | None:
    """Return the share of a thing's volume where an image shows something farther away.

    None where the image shows too little of its place, as behind a hand, or the thing is too flat.

    Args:
        thing: the thing where it was.
        frame: image with the camera's pose.
        table: what it stands on.
    """
    points = np.concatenate([_inside(piece) for piece in thing.pieces])
    points = points[table.height_above(points) > LEAST_HEIGHT]
    if not len(points):
        return None
    pixels, z = project(frame, points)
    height, width = frame.depth.shape
    in_view = (z > 0) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    u, v = pixels[in_view].T
    measured = frame.depth[v, u]
    farther = (measured - z[in_view])[measured > 0]
    shown = farther[farther > -THICK]
    if len(shown) < LEAST_SHOWN * len(points):
        return None
    return float((shown > BEHIND).mean())


def _inside(piece: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "m 3"]:
    """Return points inside a convex piece, all over its volume."""
    middle = piece.mean(axis=0)
    return np.concatenate([middle + share * (piece - middle) for share in _SHRUNK])
