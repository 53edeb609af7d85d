"""Where grasps are tried."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from manipulation.robot import GripperGeometry
from manipulation.types import Grasp


@dataclass(frozen=True)
class GraspConfig:
    """Where grasps are tried.

    Attributes:
        gripper: geometry of the hand.
        n_azimuths: directions about the object's axis.
        mug_depth, bowl_depth: of the TCP below the rim, along the wall, in [m].
        depth_shares: of these depths to try, for shallow cavities.
        least_depth: for objects so low that the fingertips would meet the support, in [m].
        top_depths: of the TCP below the top of cans and bottles in [m].
        max_wall: thickest rim to close over in [m].
        default_wall: assumed thickness in [m] where the mesh has no cavity.
        half_opening: preferred distance of each pad from the middle of the wall before closing in [m].
        min_half_opening: least such distance in [m].
        release_gap: by which each finger lets go in [m].
        max_tilt, max_inward_tilt: of the hand, for walls that widen or narrow upwards, in [rad].
        top_clearance: room at each finger before closing around a body in [m]; a little below 0, because the
            body may have been estimated too wide.
        max_taper: largest angle of a body's sides against the vertical, mean over the pads' height, in [rad]:
            friction holds cones up to it.
        fingertip_clearance: kept above the support in [m].
    """

    gripper: GripperGeometry = field(default_factory=GripperGeometry)
    n_azimuths: int = 24
    mug_depth: float = 0.013
    bowl_depth: float = 0.0155
    depth_shares: tuple[float, ...] = (1.0, 0.8, 0.6)
    least_depth: float = 0.008
    top_depths: tuple[float, ...] = (0.022, 0.016, 0.028, 0.012, 0.032)
    max_wall: float = 0.02
    default_wall: float = 0.005
    half_opening: float = 0.016
    min_half_opening: float = 0.010
    release_gap: float = 0.0045
    max_tilt: float = np.deg2rad(32.0)
    max_inward_tilt: float = 0.15
    top_clearance: float = -0.0015
    max_taper: float = np.deg2rad(27.0)
    fingertip_clearance: float = 0.005


def tcp_pose(position: np.ndarray, approach: np.ndarray, closing: np.ndarray) -> Float[np.ndarray, "4 4"]:
    """TCP frame: z along the approach, y along the closing direction."""
    T = np.eye(4)
    T[:3, 2], T[:3, 1] = approach, closing
    T[:3, 0] = np.cross(closing, approach)
    T[:3, 3] = position
    return T


def turned(grasp: Grasp) -> Grasp:
    """The same grasp with the hand turned by half a turn about its approach, the fingers swapped."""
    return replace(grasp, T_stand_tcp=grasp.T_stand_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
