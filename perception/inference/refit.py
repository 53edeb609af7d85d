"""Pose check of an object of known shape near its expected pose.

No detector is needed: the object's presence follows from the pixels whose depth agrees with it and those
measured behind it, where its pose explains the measured depth best (``pose_search``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from perception.inference.pose_search import PoseSearch, RefitConfig
from perception.rendering.pose import ObjectPose
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

PoseStatus = Literal["seen", "not_there", "hidden"]

_LEVEL = 0.01  # [rad] deviation of the prior on the tilt of an object that is level
_LEAN, _N_LEANS = np.deg2rad(20.0), 6  # tilt, and number of directions, of leaning initial poses
# [m] in the object's frame, about which they are turned: a bowl slides in the one below.
_PIVOTS = (np.zeros(3), np.array([0.0, 0.0, 0.05]))
_CLEARLY = 0.04  # share of the visible pixels by which a leaning pose must explain more

_WELL = 0.9  # share of the visible pixels from which on a level pose agrees well
_WIDE = 0.08  # [m] around the object that a search for one that was pushed aside looks at
_GRIDS = ((0.06, 0.02), (0.01, 0.01))  # [m] reaches and steps of such a search, along x and y

# An object that cannot lean, whatever covers it: its axis is vertical against any number of pixels.
STANDING = RefitConfig(tilt_sigma=1e-4)


@dataclass(frozen=True)
class PoseCheck:
    """Result of a pose check.

    Attributes:
        T_world_object: (4, 4) refined pose; the expected one unless the object is seen.
        status: "seen"; "not_there" if the cameras measure depth behind the object, or what is below
            it explains what they measure; "hidden" if too few of its pixels are visible for a decision.
        inlier_share: Share of the object's visible pixels whose depth agrees, in 0..1.
        visible_pixels: Number of visible pixels of all views, in pixels of the full images.
        tilt: Angle between the object's axis and the plane's normal, in radians.
        shift: Distance from the expected position, in metres.
    """

    T_world_object: Float[np.ndarray, "4 4"]
    status: PoseStatus
    inlier_share: float
    visible_pixels: int
    tilt: float
    shift: float


def refit_pose(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    T_expected: Float[np.ndarray, "4 4"],
    others: Sequence[ObjectEstimate] = (),
    plane: SupportPlane = SupportPlane(),
    config: RefitConfig = RefitConfig(),
) -> PoseCheck:
    """Find the object near its expected pose.

    Args:
        estimate: Object, of which only the mesh is used; it must be watertight.
        frames: Views of the expected place, with camera poses.
        T_expected: (4, 4) expected pose.
        others: Objects nearby at their poses; depth that they explain better is not attributed to the object.
        plane: Support plane.
        config: Limits and budgets.
    """
    search = PoseSearch(estimate, frames, T_expected, others, plane, config)
    expected = ObjectPose.of(T_expected, search.scale)
    best = search.refine(expected)
    if search.gain(best) < search.gain(expected):  # misled by what is not of the shape, such as contents
        best = max([expected, search.refine(expected, config.reaches[-1:])], key=search.gain)
    if search.share(best) < config.min_share:
        offsets = [(dx, dy, 0.0) for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        starts = [
            expected.moved(np.array([0, 0, 0, *(config.starts * np.array(o)), 0, 0, 0])) for o in offsets
        ]
        best = max([best, *(search.refine(start) for start in starts)], key=search.share)
    return checked(search, best, expected)


def refit_leaning(
    estimate: ObjectEstimate,
    frames: Sequence[RgbdFrame],
    T_expected: Float[np.ndarray, "4 4"],
    others: Sequence[ObjectEstimate] = (),
    plane: SupportPlane = SupportPlane(),
    config: RefitConfig = RefitConfig(),
) -> PoseCheck:
    """Find an object near its expected pose that may lean against another one.

    Level and tilted poses are compared by the pixels that agree with them: a local fit from the level pose
    misses a large tilt, and takes the errors of a coarse shape for a small one. Pixels that another object
    explains do not count, so that a lower one does not lean into the surface of the one in it. Where the
    level pose agrees poorly, the object may have been pushed aside together with what it is in, whose pixels
    are then taken for its own: level poses around are compared first.

    Args:
        estimate, frames, T_expected, others, plane, config: As those of ``refit_pose``.
    """
    upright = replace(config, tilt_sigma=_LEVEL)
    search = PoseSearch(estimate, frames, T_expected, others, plane, upright)
    before = expected = ObjectPose.of(T_expected, search.scale)
    level = search.refine(expected)
    if search.share(level) < _WELL:
        wide = replace(upright, margin=_WIDE)
        expected = _level_nearby(PoseSearch(estimate, frames, T_expected, others, plane, wide), expected)
        search = PoseSearch(estimate, frames, expected.T_world_object, others, plane, upright)
        starts = [level, expected, search.refine(expected, config.reaches[-1:])]
        level = max(starts, key=lambda pose: search.gain(pose, alone=True))
    search.config = config
    turns = [
        _LEAN * np.array([np.cos(a), np.sin(a), 0.0]) for a in 2 * np.pi * np.arange(_N_LEANS) / _N_LEANS
    ]
    starts = [level, *(expected.turned(turn, pivot) for turn in turns for pivot in _PIVOTS)]
    leaning = max((search.refine(start) for start in starts), key=lambda pose: search.gain(pose, alone=True))
    least = search.gain(level, alone=True) + _CLEARLY * sum(search.evidence(leaning))
    is_clear = search.gain(leaning, alone=True) > least
    return checked(search, leaning if is_clear else level, before)


def _level_nearby(search: PoseSearch, expected: ObjectPose) -> ObjectPose:
    """Return the pose, of those beside the expected one on a grid, with which most pixels agree."""
    for reach, step in _GRIDS:
        offsets = np.arange(-reach, reach + step / 2, step)
        steps = [np.array([0, 0, 0, x, y, 0, 0, 0, 0]) for x in offsets for y in offsets]
        expected = max(
            (expected.moved(step) for step in steps), key=lambda pose: search.gain(pose, alone=True)
        )
    return expected


def checked(search: PoseSearch, best: ObjectPose, expected: ObjectPose) -> PoseCheck:
    """Return what the measurements say of the best pose."""
    config, plane = search.config, search.plane
    agree, through = search.evidence(best)
    visible = agree + through
    status: PoseStatus = "seen"
    if visible < config.min_pixels:
        status = "hidden"
    elif agree / visible < config.min_share or search.own(best) / visible < config.min_own:
        status = "not_there"
    found = best if status == "seen" else expected
    return PoseCheck(
        T_world_object=found.T_world_object,
        status=status,
        inlier_share=float(agree / max(visible, 1)),
        visible_pixels=int(visible),
        tilt=float(np.arccos(np.clip(found.rotation[:, 2] @ plane.normal, -1, 1))),
        shift=float(np.linalg.norm(found.translation - expected.translation)),
    )
