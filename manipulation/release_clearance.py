"""Whether the hand has room to let go: its outline seen from above against the heights of what stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from manipulation.footprints import BoxRaster
from manipulation.robot import GripperGeometry
from manipulation.types import Grasp
from perception.geometry import pose_from_yaw

_FINGER_ACROSS = np.array([-0.01, 0.0, 0.01])  # [m] from the middle of a finger, across the closing axis
_PALM_SAMPLES, _PALM_INNER = 15, 0.015  # along the closing axis; [m] from the middle across it
_FINGER_CLEARANCE, _PALM_CLEARANCE = 0.003, 0.006


def count_releases(
    raster: BoxRaster,
    grasps: Sequence[Grasp],
    position: Float[np.ndarray, "2"],
    yaw: float,
    base: float,
    gripper: GripperGeometry | None = None,
) -> int:
    """Grasps whose fingers, opened to let go, and palm meet nothing that stands already.

    Args:
        raster: what stands, and how high.
        grasps: of the object that is being let go.
        position: of its stand frame, relative to the raster's centre, in [m].
        yaw: of its stand frame in [rad].
        base: height of its base while it is let go, in [m].
        gripper: geometry of the hand.
    """
    if not grasps:
        return 0
    gripper = gripper or GripperGeometry()
    T_box_stand = pose_from_yaw(yaw, np.array([position[0], position[1], base]))
    Ts = T_box_stand @ np.stack([grasp.T_stand_tcp for grasp in grasps])
    # Sample points of the hand along the closing axis and across it: palm, and fingers behind their pads.
    palm_along = np.linspace(-gripper.palm_half_length, gripper.palm_half_length, _PALM_SAMPLES)
    palm_across = np.array([-gripper.palm_half_width, -_PALM_INNER, _PALM_INNER, gripper.palm_half_width])
    palm = _points(Ts, np.broadcast_to(palm_along, (len(Ts), _PALM_SAMPLES)), palm_across, -gripper.palm)
    free = _is_above(raster, palm, _PALM_CLEARANCE)
    finger_along = np.linspace(0.0, gripper.finger_reach, 4)
    half_opening = np.array([grasp.release_opening / 2 for grasp in grasps])
    for side in (-1, 1):
        along = side * (half_opening[:, None] + finger_along)
        free &= _is_above(raster, _points(Ts, along, _FINGER_ACROSS, gripper.tip), _FINGER_CLEARANCE)
    return int(free.sum())


def _points(
    Ts_box_tcp: Float[np.ndarray, "g 4 4"],
    along: Float[np.ndarray, "g a"],
    across: Float[np.ndarray, "c"],
    depth: float,
) -> Float[np.ndarray, "g a c 3"]:
    """Points of the hand ``along`` and ``across`` the closing axis, ``depth`` [m] beyond the TCP."""
    x, y, z, origin = (Ts_box_tcp[:, None, None, :3, column] for column in range(4))
    return origin + along[:, :, None, None] * y + across[:, None] * x + depth * z


def _is_above(
    raster: BoxRaster, points: Float[np.ndarray, "g a c 3"], clearance: float
) -> Bool[np.ndarray, "g"]:
    """Whether all points of each hand are higher than what stands below them."""
    free = raster.highest(points[..., :2]) < points[..., 2] - clearance
    return np.asarray(free.all(axis=(1, 2)))
