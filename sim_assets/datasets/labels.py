"""Images of tables with ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from perception.types import Category, RestingPose, RgbdFrame, SupportPlane
from sim_assets.datasets.perceived import TABLE


@dataclass(frozen=True)
class InstanceLabel:
    """Ground truth of one item in an image.

    Attributes:
        category: class of the object; None for a distractor.
        T_world_object: (4, 4) pose, origin at the centre of its base, mug handle along +x.
        pixels: number of visible pixels.
        outline_pixels: area of the convex hull of its projection, occluded and truncated parts included.
        height: height of the item in [m].
        foot: (3,) origin of the object as the frame shows it, with the errors of its calibration [m].
        ignored: whether the item is an object in a pose whose class is not to be learned.
        resting: resting pose of an object.
    """

    category: Category | None
    T_world_object: Float[np.ndarray, "4 4"]
    pixels: int
    outline_pixels: float
    height: float
    foot: Float[np.ndarray, "3"]
    ignored: bool = False
    resting: RestingPose = "upright"

    @property
    def yaw(self) -> float:
        """Angle of the object's +x about the world's z in [rad]."""
        return float(np.arctan2(self.T_world_object[1, 0], self.T_world_object[0, 0]))

    @property
    def direction(self) -> float:
        """Angle about the world's z in [rad] of a mug's handle, or of the axis of what lies, base to top.

        The axis of a lying item is along -y of its mesh.
        """
        return self.yaw - np.pi / 2 if self.resting == "lying" else self.yaw


@dataclass(frozen=True)
class LabelledImage:
    """An RGB-D image with ground truth; the table is the plane z = 0 of the true world.

    Attributes:
        frame: colour, noisy depth, intrinsics and pose of the camera.
        instances: (H, W) index into ``labels`` of the visible item, -1 for table and background.
        labels: all items on the table, visible or not.
        plane: the table's plane as the frame shows it, with the errors of sensor and calibration.
        surroundings: (H, W) where furniture and the like around the table is seen; all False if None.
    """

    frame: RgbdFrame
    instances: Int[np.ndarray, "h w"]
    labels: tuple[InstanceLabel, ...]
    plane: SupportPlane = TABLE
    surroundings: Bool[np.ndarray, "h w"] | None = None
