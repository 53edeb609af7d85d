"""Bounding spheres of the landmarks, as a camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from perception.geometry import invert
from perception.slam.landmarks import LandmarkMap

_NEAREST, _NEAREST_FAR = 0.02, 0.05  # [m] lower bounds of a depth range's two ends


@dataclass(frozen=True)
class BoundingSpheres:
    """Bounding spheres of all landmarks, in the order of ``LandmarkMap.ids``.

    Attributes:
        centres: Centres in the camera frame, in metres.
        radii: Radii, in metres.
    """

    centres: Float[np.ndarray, "o 3"]
    radii: Float[np.ndarray, "o"]

    @staticmethod
    def of(
        world: LandmarkMap, T_world_camera: Float[np.ndarray, "4 4"], margin: float = 0.0
    ) -> BoundingSpheres:
        """Return the spheres of a map, their radii enlarged by ``margin`` [m]."""
        landmarks = [world.landmarks[id] for id in world.ids]
        T_camera_world = invert(T_world_camera)
        centres = np.array([landmark.state.pose.translation for landmark in landmarks]).reshape(-1, 3)
        centres = centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        return BoundingSpheres(
            centres, np.array([landmark.bounding_radius for landmark in landmarks]) + margin
        )

    @property
    def depth_range(self) -> Float[np.ndarray, "o 2"]:
        """Depth of the nearest and the farthest point of each sphere, in metres."""
        z = self.centres[:, 2]
        near, far = np.maximum(z - self.radii, _NEAREST), np.maximum(z + self.radii, _NEAREST_FAR)
        return np.stack([near, far], axis=1)

    def hit_by(self, directions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n o"]:
        """Return which rays from the camera centre intersect which spheres."""
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        along = unit @ self.centres.T
        miss2 = (self.centres**2).sum(axis=1) - along**2
        return (along > 0) & (miss2 < self.radii**2)
