"""Display options, and what all layers of the 3-D scene share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.viewer.snapshot import Snapshot

Coloring = Literal["class", "uncertainty"]
ObjectSource = Literal["reconstructed", "true", "both"]


@dataclass(frozen=True)
class DisplayOptions:
    """Choices of the user.

    Attributes:
        objects: Reconstructed objects, the true ones of the simulator, or both.
        goals: Whether to show ghosts of the objects at their goal poses.
        cameras: Whether to show the cameras of the images.
        motion: Whether to show the planned path and the grasp candidates.
        labels: Whether to show the names of the objects.
        shadows: Whether the key light casts shadows.
        coloring: Colour of the reconstructed objects.
    """

    objects: ObjectSource = "reconstructed"
    goals: bool = True
    cameras: bool = True
    motion: bool = True
    labels: bool = True
    shadows: bool = True
    coloring: Coloring = "class"


class Layer(Protocol):
    """One kind of content of the scene."""

    def draw(self, snapshot: Snapshot, options: DisplayOptions) -> None:
        """Update the layer to a snapshot; only changes are sent to the browsers."""
        ...


def pose_arguments(T: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Return a pose as viser's keyword arguments."""
    return {"position": T[:3, 3], "wxyz": Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)}


def set_pose(handle: Any, T: Float[np.ndarray, "4 4"]) -> None:
    """Move a node of the scene."""
    for name, value in pose_arguments(T).items():
        setattr(handle, name, value)
