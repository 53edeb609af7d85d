"""Whether the hand has room to let go: its outline seen from above against the heights of what stands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from manipulation.footprints import BoxRaster
from manipulation.grasp_config import GripperGeometry
from manipulation.types import Grasp

# Sample points of the hand's outline in [m], along and across the closing axis: finger behind its pad, palm.
_FINGER_ALONG, _FINGER_ACROSS = np.linspace(0.0, 0.0205, 4), (-0.01, 0.0, 0.01)
_PALM_ALONG, _PALM_ACROSS = np.linspace(-0.105, 0.105, 15), (-0.035, -0.015, 0.015, 0.035)
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
    """
    if not grasps:
        return 0
    gripper = gripper or GripperGeometry()
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, s], [-s, c]])
    T = np.stack([grasp.T_stand_tcp for grasp in grasps])
    closing, sideways = T[:, :2, 1] @ turn, T[:, :2, 0] @ turn
    origin, height = T[:, :2, 3] @ turn + position, T[:, 2, 3] + base
    half_opening = np.array([grasp.release_opening / 2 for grasp in grasps])
    frame = origin, closing, sideways
    palm = np.broadcast_to(_PALM_ALONG, (len(grasps), len(_PALM_ALONG)))
    free = _highest_under(raster, *frame, palm, _PALM_ACROSS) < height + gripper.palm - _PALM_CLEARANCE
    for side in (-1, 1):
        finger = side * (half_opening[:, None] + _FINGER_ALONG)
        below = _highest_under(raster, *frame, finger, _FINGER_ACROSS)
        free &= below < height - gripper.tip - _FINGER_CLEARANCE
    return int(free.sum())


def _highest_under(
    raster: BoxRaster,
    origin: np.ndarray,
    closing: np.ndarray,
    sideways: np.ndarray,
    along: np.ndarray,
    across: tuple[float, ...],
) -> Float[np.ndarray, "g"]:
    """Greatest height under points ``along`` (g, a) and ``across`` the closing directions of grasps."""
    points = (
        origin[:, None, None]
        + closing[:, None, None] * along[:, :, None, None]
        + sideways[:, None, None] * np.array(across)[:, None]
    )
    return raster.highest(points).max(axis=(1, 2))
