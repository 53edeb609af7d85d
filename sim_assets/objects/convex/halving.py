"""Convex pieces of closed surfaces by repeated halving: for what is bent, hollow or waisted.

For the parts of things that are drawn anew in every scene: at most tenths of a second, where coacd takes
seconds. Corners inside deep vessels are filled by up to 2 cm.
"""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from manifold3d import Error, Manifold, Mesh

from perception.obstacles.obstacle import is_within

DENT = 3e-3  # [m], depth to which a piece may be hollow
MOST_HALVINGS = 6  # one after another; at most 2 ** MOST_HALVINGS connected pieces of a part
_NO_VOLUME = 1e-9  # [m³]


def halved_pieces(
    part: trimesh.Trimesh, dent: float = DENT, halvings: int = MOST_HALVINGS
) -> list[Float[np.ndarray, "_n 3"]]:
    """Return the corners [m] of convex pieces that together fill a closed surface, and little more.

    A part that is hollow to a greater depth is cut through the middle of its bounds, across the longest
    extent, and so are its halves. A surface that is not closed has one piece, its hull.

    Args:
        part: connected surface [m].
        dent: depth to which a piece may be hollow [m].
        halvings: largest number of cuts one after another.
    """
    surface = Mesh(np.asarray(part.vertices, np.float32), np.asarray(part.faces, np.uint32))
    solid = Manifold(surface)
    if solid.status() != Error.NoError or solid.volume() < _NO_VOLUME:
        return [np.asarray(part.convex_hull.vertices)]
    return [_corners(piece) for piece in _convex_parts(solid, dent, halvings)]


def _convex_parts(solid: Manifold, dent: float, halvings: int) -> list[Manifold]:
    hull = solid.hull()
    if halvings == 0 or not _is_hollow(solid, hull, dent):
        return [hull]
    return [piece for half in _halves(solid) for piece in _convex_parts(half, dent, halvings - 1)]


def _is_hollow(solid: Manifold, hull: Manifold, dent: float) -> bool:
    """Return whether a vertex is deeper [m] below the hull, or the hull adds more thickness on average.

    A straight hollow has no vertices but at its ends, and is noticed by the thickness.
    """
    added = (hull.volume() - solid.volume()) / (0.5 * solid.surface_area())
    return added >= dent or bool(is_within(_corners(solid), _corners(hull), -dent).any())


def _halves(solid: Manifold) -> list[Manifold]:
    """Return the connected parts on both sides of the plane through the middle of the longest extent."""
    low, high = np.reshape(solid.bounding_box(), (2, 3))
    normal = np.eye(3)[np.argmax(high - low)]
    sides = solid.split_by_plane(normal, normal @ (low + high) / 2)
    return [part for side in sides for part in side.decompose() if part.volume() > _NO_VOLUME]


def _corners(solid: Manifold) -> Float[np.ndarray, "_n 3"]:
    return np.asarray(solid.to_mesh().vert_properties[:, :3], dtype=float)
