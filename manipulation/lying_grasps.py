"""Grasps of a lying object across its axis, from above, with which it can be set upright.

The hand turns by 90 degrees about its closing direction between pick and place, and is horizontal in the end,
with the wrist camera above it.
"""

from __future__ import annotations

import itertools
from collections import Counter
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from manipulation.cross_sections import CrossSectionCache, Extent, extent
from manipulation.grasp_config import GraspConfig, half_turn, on_hand, tcp_pose
from manipulation.types import TOO_WIDE, Grasp, GraspSet, Rejected, StandingObject

LYING_TILT = np.deg2rad(45.0)  # of the axis to the vertical, from which on an object does not stand
HAND_HEIGHT = 0.07  # [m] least height of the TCP over the support with the hand horizontal
_STEP = 0.008  # [m] between grasps along the axis
_PAD_HALF_WIDTH = 0.0085  # [m] along the axis
_FEW = 4  # places along the axis up to which the hand comes obliquely as well
_ROLLS = np.deg2rad([25.0, -25.0, 45.0, -45.0])  # about the axis
_OBLIQUE = 1.0  # by which the score of such a grasp is lower
_ROOM = 0.012  # [m] between the open pads beside the object, below which narrower places are preferred


def lies(T_world_stand: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether an object does not stand upright."""
    return bool(T_world_stand[2, 2] < np.cos(LYING_TILT))


def is_upside_down(T_world_stand: Float[np.ndarray, "4 4"]) -> bool:
    """Return whether an object stands on its top."""
    return bool(T_world_stand[2, 2] < -np.cos(LYING_TILT))


def lying_grasps(
    item: StandingObject,
    T_world_stand: Float[np.ndarray, "4 4"],
    config: GraspConfig = GraspConfig(),
    least_height: float = HAND_HEIGHT,
) -> GraspSet:
    """Return grasps from above across the axis of a lying object, the one nearest to its middle first.

    Where that nearly fills the hand, narrower places come before it, and where its sides are tapered, so that
    it slides along its axis when the pads close, places with parallel sides. If there are few, as at the neck
    of a bottle whose body is too wide, obliquely from above come last: the palm is beside the object then.

    Args:
        item: the object.
        T_world_stand: its pose.
        config: settings of grasp generation.
        least_height: smallest height of the TCP above the object's base in [m]; that with which it can be set
            upright by default.
    """
    rejected: Counter[str] = Counter()
    if is_upside_down(T_world_stand):
        rejected["upside down"] += 1
        return GraspSet((), rejected)
    sections = CrossSectionCache(item.vertices, item.faces)
    grasps: list[Grasp] = []
    found: list[float] = []
    for height in np.arange(0.03, item.top - _PAD_HALF_WIDTH, _STEP):
        if height < least_height:
            rejected["too near to the base to be set upright"] += 1
            continue
        grasp = _across(item, sections, T_world_stand, float(height), config)
        if isinstance(grasp, Rejected):
            rejected[grasp.reason] += 1
        else:
            found.append(float(height))
            grasps.append(grasp)
    if len(found) <= _FEW:
        for height, roll in itertools.product(found, _ROLLS):
            oblique = _across(item, sections, T_world_stand, height, config, roll)
            if isinstance(oblique, Grasp):
                grasps.append(replace(oblique, score=oblique.score - _OBLIQUE))
    # With the hand the other way round, and the camera below when the object is set upright.
    grasps += [replace(half_turn(grasp), score=grasp.score - 2.0) for grasp in grasps]
    ordered = tuple(sorted(grasps, key=lambda grasp: -grasp.score))
    return on_hand(GraspSet(ordered, rejected), config.gripper)


def _across(
    item: StandingObject,
    sections: CrossSectionCache,
    T_world_stand: Float[np.ndarray, "4 4"],
    height: float,
    config: GraspConfig,
    roll: float = 0.0,
) -> Grasp | Rejected:
    """Return the grasp that closes across the axis at a height [m] above the base.

    The hand comes from above, turned about the axis by ``roll`` [rad].
    """
    vertical = T_world_stand[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    angle = np.arctan2(vertical[1], vertical[0]) + roll
    up = np.array([np.cos(angle), np.sin(angle), 0.0])  # across the axis, in the stand frame
    closing = np.cross((0.0, 0.0, 1.0), up)  # the hand's x, with the camera, points to the object's top
    azimuth = float(np.arctan2(closing[1], closing[0]))
    across = _extents(sections, height, azimuth)
    along = _extents(sections, height, azimuth + np.pi / 2)  # the approach
    if len(across) < 3 or len(along) < 3:
        return Rejected("without material between the pads")
    gripper, widths = config.gripper, [e.width for e in across]
    width = max(widths)
    if width > gripper.max_width - 0.004:
        return Rejected(f"{TOO_WIDE} for {gripper.max_width:.2f} m")
    taper = float(np.arctan2(np.ptp(widths) / 2, 2 * _PAD_HALF_WIDTH))
    if taper > config.max_taper:
        return Rejected("too tapered")
    sideways = np.array([-closing[1], closing[0], 0.0])
    position = across[1].middle * closing + along[1].middle * sideways
    position = position + np.array([0.0, 0.0, height])
    tips = float((T_world_stand @ np.append(position - gripper.tip * up, 1.0))[2])
    low = tips - np.sin(abs(roll)) * width / 2 - config.fingertip_clearance
    position = position - min(low, 0.0) / np.cos(roll) * up  # the fingertips stay above the support
    opening = min(gripper.max_width, width + 0.024)
    narrowness = min(gripper.max_width - width, _ROOM) / _ROOM  # the estimated width may be too small
    return Grasp(
        kind="waist",
        T_stand_tcp=tcp_pose(position, approach=-up, closing=closing),
        away=up,
        opening=opening,
        held_width=width,
        closed_width=(0.5 * width, opening - 0.002),
        release_opening=min(width + 2 * config.release_gap, gripper.max_width),
        depth=item.top - height,
        azimuth=azimuth,
        score=0.5 + 0.5 * narrowness - abs(height - 0.55 * item.top) / item.top - taper,
    )


def _extents(sections: CrossSectionCache, height: float, azimuth: float) -> list[Extent]:
    """Return the extents of the cross-sections under the width of the pads, of which none is empty."""
    heights = height + _PAD_HALF_WIDTH * np.array([-1.0, 0.0, 1.0])
    found = (extent(sections.at(float(z)), azimuth) for z in heights)
    return [e for e in found if e is not None]
