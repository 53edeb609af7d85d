"""True states of the objects, for rewards, privileged observations and data sets; never for perception."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from perception.types import CATEGORIES
from sim_assets.cell.ground_truth import ObjectStates, object_models
from sim_assets.cell.world import World

COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz", *CATEGORIES, "height", "radius")


class PrivilegedState:
    """Reads the true states of the objects of a cell.

    Attributes:
        categories: Class of each object.
        heights: Height of each object in metres.
        radii: Radius of each object's bounding cylinder about its axis, in metres.
    """

    def __init__(self, world: World) -> None:
        models = list(object_models(world).values())
        self._states = ObjectStates(world)
        self.categories = tuple(model.category for model in models)
        self.heights = np.array([model.height for model in models])
        self.radii = np.array([np.linalg.norm(model.mesh.vertices[:, :2], axis=1).max() for model in models])
        classes = np.array([[category == name for name in CATEGORIES] for category in self.categories])
        self._constants = np.column_stack([classes, self.heights, [model.radius for model in models]])

    def read(self) -> tuple[Float[np.ndarray, "n 7"], Float[np.ndarray, "n 6"]]:
        """Return positions [m] with quaternions wxyz, and linear [m/s] with angular [rad/s] velocities."""
        return self._states.read()

    def table(self) -> Float[np.ndarray, "n 13"]:
        """Return one row per object with the entries ``COLUMNS``, in metres."""
        poses, _ = self._states.read()
        return np.concatenate([poses, self._constants], axis=1).astype(np.float32)
