"""Parameters of grasp generation, and the frames that all grasp types share."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from manipulation.robot import GripperGeometry
from manipulation.types import Grasp, GraspSet

_NEARER = 0.008  # [m] by which the fixed pad of a hand with one moving jaw is nearer to the object
_STAND_OFF = 0.003  # [m], the least if there is room
_NARROW = 0.007  # [m] of each pad from the middle of the wall
_SHALLOW = 0.002  # [m] of the TCP below the rim: the pads reach to the fingertips, about 1 cm further


@dataclass(frozen=True)
class GraspConfig:
    """Parameters of grasp generation.

    Attributes:
        gripper: geometry of the hand.
        n_azimuths: number of directions about the object's axis.
        mug_depth, bowl_depth: depth of the TCP below the rim, along the wall, in [m].
        depth_fractions: multiples of that depth, tried in order, for shallow cavities.
        min_depth: smallest depth, for objects so low that the fingertips would touch the support, in [m].
        top_depths: depths of the TCP below the top of cans and bottles in [m].
        max_wall: largest wall thickness of a rim grasp in [m].
        default_wall: wall thickness in [m] assumed where the mesh has no cavity.
        half_opening: preferred distance of each pad from the middle of the wall before closing in [m].
        min_half_opening: smallest such distance in [m].
        release_gap: distance in [m] by which each finger opens to release the object.
        max_tilt, max_inward_tilt: largest tilt of the hand for walls that widen or narrow upwards, in [rad].
        top_clearance: clearance between each finger and a body before closing in [m]; slightly negative,
            because the estimated body may be too wide.
        max_taper: largest mean angle of a body's sides to the vertical over the pads' height, in [rad]; the
            limit of friction.
        height_error: error in [m] of the height at which shoulders begin, which counts in the scores.
        fingertip_clearance: height of the fingertips above the support in [m].
    """

    gripper: GripperGeometry = field(default_factory=GripperGeometry)
    n_azimuths: int = 24
    mug_depth: float = 0.013
    bowl_depth: float = 0.010
    depth_fractions: tuple[float, ...] = (1.0, 0.8, 0.6)
    min_depth: float = 0.008
    top_depths: tuple[float, ...] = (0.022, 0.016, 0.028, 0.012, 0.032, 0.006)
    max_wall: float = 0.02
    default_wall: float = 0.005
    half_opening: float = 0.016
    min_half_opening: float = 0.010
    release_gap: float = 0.0045
    max_tilt: float = np.deg2rad(32.0)
    max_inward_tilt: float = 0.15
    top_clearance: float = -0.0015
    max_taper: float = np.deg2rad(27.0)
    height_error: float = 0.004
    fingertip_clearance: float = 0.005

    def shallow(self) -> GraspConfig:
        """Return the parameters of rim grasps as near to the rim as the pads hold it."""
        return replace(self, mug_depth=_SHALLOW, bowl_depth=_SHALLOW, min_depth=_SHALLOW)

    def narrow(self) -> GraspConfig:
        """Return the parameters of grasps between walls that are close to each other."""
        return replace(self, half_opening=_NARROW, min_half_opening=_NARROW)


def tcp_pose(
    position: Float[np.ndarray, "3"], approach: Float[np.ndarray, "3"], closing: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a TCP with z along the approach and y along the closing direction (unit vectors)."""
    T = np.eye(4)
    T[:3, 2], T[:3, 1] = approach, closing
    T[:3, 0] = np.cross(closing, approach)
    T[:3, 3] = position
    return T


def on_hand(grasps: GraspSet, gripper: GripperGeometry) -> GraspSet:
    """Return grasps that were made for two moving fingers, their TCP in the middle, as those of a given hand.

    A hand with one moving jaw stands with its fixed pad a little beside the object and draws the object
    against that pad when it closes.
    """
    if not gripper.one_jaw:
        return grasps
    return replace(grasps, grasps=tuple(_on_jaw(grasp) for grasp in grasps.grasps))


def _on_jaw(grasp: Grasp) -> Grasp:
    beside = 0.5 * (grasp.opening - grasp.held_width)  # of each pad of a hand with two moving fingers
    stand_off = max(beside - _NEARER, min(_STAND_OFF, beside))
    T = grasp.T_stand_tcp.copy()
    T[:3, 3] -= 0.5 * grasp.held_width * T[:3, 1]
    opening = grasp.opening - beside + stand_off
    low, high = grasp.closed_width
    return replace(
        grasp,
        T_stand_tcp=T,
        stand_off=stand_off,
        opening=opening,
        closed_width=(low, min(high, opening - 0.001)),
    )


def half_turn(grasp: Grasp) -> Grasp:
    """Return the grasp with the hand rotated by pi about its approach, which swaps the fingers."""
    return replace(grasp, T_stand_tcp=grasp.T_stand_tcp @ np.diag([-1.0, -1.0, 1.0, 1.0]))
