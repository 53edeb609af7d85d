"""All settings of the SLAM system."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from perception.inference.fit import FitConfig
from perception.slam.association import AssociationConfig
from perception.slam.bundle_adjustment import JointConfig
from perception.slam.motion import MotionConfig
from perception.slam.pixels import SelectionConfig
from perception.slam.relocalise import RelocalisationConfig
from perception.slam.tracking import TrackingConfig


@dataclass(frozen=True)
class LifeConfig:
    """When landmarks come and go, and when the camera is lost.

    Attributes:
        min_pixels: of a mask that a landmark is made from.
        min_pixels_cut: the same of a mask that the image border cuts.
        enough: landmarks that agree with a frame, by ``enough_share`` of their pixels, while a cut mask waits
            to come into view: what is made from a part of an object may be far off.
        seen_before: frames in a row that must show an unmatched mask before it becomes a landmark.
        new_part: of an object's pixels, which no keyframe had in view, that makes a frame a keyframe.
        retry: frames until an object that could not be initialised is tried again, and at least between
            keyframes that complete one.
        retry_weak: the latter while the pose is weak.
        check_every: so many frames it is looked which landmarks should be seen.
        max_misses: such looks in a row at which a landmark should be seen but is not; fewer for one that was
            seen in fewer frames.
        through_share: of a landmark's visible pixels; where more see what is behind it, it is not there.
        max_through: such looks in a row at which it is not.
        max_bad: frames in a row in which most of its pixels disagree.
        moved_after: such frames in a row after which it is fitted anew where it is seen.
        moved_by: from which distance on it was moved, and older views of it are forgotten [m].
        lost_share: median share of agreeing pixels under which the camera is lost.
        weak_spread, lost_spread: standard deviation of the camera's place, by its motion and by what the
            landmarks say, from which on the pose is weak, and from which on it is lost [m].
        found_spread: up to which a lost camera counts as found [m].
        search_spread: up to which a lost camera is looked for where its motion leads first [m].
        max_keyframes: are kept; then the oldest go.
        class_margin: log probability by which another class must lead before an object is fitted anew.
        max_move, max_turn: of the camera between two frames [m], [rad]; more is a slip.
    """

    min_pixels: int = 120
    min_pixels_cut: int = 400
    enough: int = 3
    enough_share: float = 0.6
    seen_before: int = 2
    new_part: float = 0.3
    retry: int = 8
    retry_weak: int = 2
    check_every: int = 4
    max_misses: int = 5
    through_share: float = 0.6
    max_through: int = 2
    max_bad: int = 12
    moved_after: int = 3
    moved_by: float = 0.03
    lost_share: float = 0.5
    weak_spread: float = 0.01
    lost_spread: float = 0.02
    found_spread: float = 0.015
    search_spread: float = 0.06
    max_keyframes: int = 80
    class_margin: float = 4.0
    max_move: float = 0.10
    max_turn: float = np.radians(12.0)


@dataclass(frozen=True)
class SlamConfig:
    """All settings of the system."""

    joint_on: bool = True
    fit: FitConfig = field(default_factory=lambda: FitConfig(refine=None))  # landmarks have no meshes
    motion: MotionConfig = field(default_factory=MotionConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    selection: SelectionConfig = field(default_factory=SelectionConfig)
    association: AssociationConfig = field(default_factory=AssociationConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    joint: JointConfig = field(default_factory=JointConfig)
    life: LifeConfig = field(default_factory=LifeConfig)

    def objects_only(self) -> SlamConfig:
        """Without the plane as a landmark, as in the paper."""
        return replace(
            self,
            tracking=replace(self.tracking, use_plane=False),
            joint=replace(self.joint, use_plane=False),
        )
