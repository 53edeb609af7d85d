"""Points on the surfaces around an object, for fast checks of the hand alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from manipulation.hand_collision import one_per_cell, surface_points
from manipulation.hulls import hull_faces, reduced_hull
from manipulation.types import StandingObject
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import TriangleMesh

REACH = 0.40  # [m] from the base of a grasped object to the far end of the hand
_SPACING = 0.008  # [m] between the points that are kept; fingers are 17 mm wide


class Surfaces:
    """Points on the surfaces of objects and things of no class [m], computed once for each."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, Float[np.ndarray, "_n 3"]]] = {}  # with what keeps its id

    def of_object(self, item: StandingObject) -> Float[np.ndarray, "_n 3"]:
        """Return points on an object in its stand frame."""
        return self._once(item, lambda: surface_points(TriangleMesh(item.vertices, item.faces)))

    def of_thing(self, obstacle: PerceivedObstacle) -> Float[np.ndarray, "_n 3"]:
        """Return points on the pieces of a thing in the world frame."""
        return self._once(obstacle, lambda: np.concatenate([_on_piece(piece) for piece in obstacle.pieces]))

    def _once(
        self, key: object, points: Callable[[], Float[np.ndarray, "_n 3"]]
    ) -> Float[np.ndarray, "_n 3"]:
        if id(key) not in self._known:
            self._known[id(key)] = key, points()
        return self._known[id(key)][1]


def points_around(
    center: Float[np.ndarray, "3"],
    others: Sequence[tuple[StandingObject, Float[np.ndarray, "4 4"]]],
    obstacles: Sequence[PerceivedObstacle],
    surfaces: Surfaces | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Return points on everything near a point, relative to it in the axes of the world [m].

    Args:
        center: the point.
        others: objects with T_world_stand.
        obstacles: things of no class.
        surfaces: points that are known from calls before.
    """
    surfaces = surfaces or Surfaces()
    found = [np.zeros((0, 3))]
    found += [surfaces.of_object(item) @ T[:3, :3].T + T[:3, 3] for item, T in others]
    found += [surfaces.of_thing(obstacle) for obstacle in obstacles]
    points = np.concatenate(found) - center
    return one_per_cell(points[np.linalg.norm(points, axis=1) < REACH], _SPACING)


def _on_piece(piece: Float[np.ndarray, "_k 3"]) -> Float[np.ndarray, "_n 3"]:
    vertices = reduced_hull(piece)
    return surface_points(TriangleMesh(vertices, hull_faces(vertices).reshape(-1, 3)))
