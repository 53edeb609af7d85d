"""Points on the surfaces around an object, for fast checks of the hand alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manipulation.hand_collision import surface_points
from manipulation.hulls import hull_faces, reduced_hull
from manipulation.types import StandingObject
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import TriangleMesh

REACH = 0.40  # [m] from the base of a grasped object to the far end of the hand
_SPACING = 0.008  # [m] between the points that are kept; fingers are 17 mm wide


def points_around(
    center: Float[np.ndarray, "3"],
    others: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]],
    obstacles: Sequence[PerceivedObstacle],
) -> Float[np.ndarray, "n 3"]:
    """Return points on everything near a point, relative to it in the axes of the world [m].

    Args:
        center: the point.
        others: objects with T_world_stand.
        obstacles: things of no class.
    """
    found = [np.zeros((0, 3))]
    for item, T in others:
        found.append(surface_points(TriangleMesh(item.vertices, item.faces)) @ T[:3, :3].T + T[:3, 3])
    for obstacle in obstacles:
        for piece in obstacle.pieces:
            vertices = reduced_hull(piece)
            faces = hull_faces(vertices).reshape(-1, 3)
            found.append(surface_points(TriangleMesh(vertices, faces)))
    points = np.concatenate(found) - center
    points = points[np.linalg.norm(points, axis=1) < REACH]
    _, kept = np.unique(np.floor(points / _SPACING).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(kept)]
