"""Clearance of the hand at release: points of palm and fingers against the height raster of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from manipulation.footprints import BoxRaster
from manipulation.robot import GripperGeometry
from manipulation.types import Grasp
from perception.geometry import pose_from_yaw

_PALM_SAMPLES = 15  # number of samples of the palm along the closing axis
_PALM_INNER = 0.015  # [m] of the inner samples of the palm across the closing axis
FINGER_CLEARANCE, PALM_CLEARANCE = 0.003, 0.006  # [m]


@dataclass(frozen=True)
class ReleasePose:
    """Pose of an object's stand frame at release, relative to the centre of the box.

    Attributes:
        position: (x, y) in [m].
        yaw: rotation about z in [rad].
        base: height above the table in [m].
    """

    position: Float[np.ndarray, "2"]
    yaw: float
    base: float


def count_free_releases(
    raster: BoxRaster,
    grasps: Sequence[Grasp],
    pose: ReleasePose,
    gripper: GripperGeometry = GripperGeometry(),
) -> int:
    """Return the number of grasps whose palm and opened fingers are above the scene at release.

    Args:
        raster: heights of the scene.
        grasps: grasps of the released object.
        pose: pose at release.
        gripper: geometry of the hand.
    """
    if not grasps:
        return 0
    T_box_stand = pose_from_yaw(pose.yaw, np.array([*pose.position, pose.base]))
    Ts = T_box_stand @ np.stack([grasp.T_stand_tcp for grasp in grasps])
    # Sample points along and across the closing axis: of the palm, and of the fingers behind their pads.
    palm_along = np.linspace(-gripper.palm_half_length, gripper.palm_half_length, _PALM_SAMPLES)
    palm_across = np.array([-gripper.palm_half_width, -_PALM_INNER, _PALM_INNER, gripper.palm_half_width])
    palm = _points(Ts, np.broadcast_to(palm_along, (len(Ts), _PALM_SAMPLES)), palm_across, -gripper.palm)
    free = _is_above(raster, palm, PALM_CLEARANCE)
    finger_along = np.linspace(0.0, gripper.finger_reach, 4)
    finger_across = gripper.finger_half_width * np.array([-1.0, 0.0, 1.0])
    middle = np.array([gripper.pads_middle(grasp.release_opening) for grasp in grasps])
    half_opening = np.array([grasp.release_opening / 2 for grasp in grasps])
    for side in (-1, 1):
        along = middle[:, None] + side * (half_opening[:, None] + finger_along)
        free &= _is_above(raster, _points(Ts, along, finger_across, gripper.tip), FINGER_CLEARANCE)
    return int(free.sum())


def _points(
    Ts_box_tcp: Float[np.ndarray, "g 4 4"],
    along: Float[np.ndarray, "g a"],
    across: Float[np.ndarray, "c"],
    depth: float,
) -> Float[np.ndarray, "g a c 3"]:
    """Return points ``along`` and ``across`` the closing axis, ``depth`` [m] beyond the TCP."""
    x, y, z, origin = (Ts_box_tcp[:, None, None, :3, column] for column in range(4))
    return origin + along[:, :, None, None] * y + across[:, None] * x + depth * z


def _is_above(
    raster: BoxRaster, points: Float[np.ndarray, "g a c 3"], clearance: float
) -> Bool[np.ndarray, "g"]:
    """Return for each grasp whether all points are at least ``clearance`` [m] above the scene."""
    free = raster.highest(points[..., :2]) < points[..., 2] - clearance
    return np.asarray(free.all(axis=(1, 2)))
