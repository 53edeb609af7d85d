"""All settings of the SLAM system."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from perception.inference.fit import FitConfig
from perception.slam.association import AssociationConfig
from perception.slam.joint import JointConfig
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
        retry: frames until an object that could not be initialised is tried again.
        check_every: so many frames it is looked which landmarks should be seen.
        max_misses: such looks in a row at which a landmark should be seen but is not.
        through_share: of a landmark's visible pixels; where more see what is behind it, it is not there.
        max_through: such looks in a row at which it is not.
        max_bad: frames in a row in which most of its pixels disagree.
        lost_share: median share of agreeing pixels under which the camera is lost.
        weak_move: standard deviation of the camera's place from which on the pose is weak [m].
        growing_move: standard deviation up to which a weak pose may give new landmarks [m].
        max_weak: weak frames in a row after which the camera counts as lost.
        max_blind: frames for which a lost camera is looked for near its last pose first.
        max_keyframes: are kept; then the oldest go.
        class_margin: log probability by which another class must lead before an object is fitted anew.
        max_move, max_turn: of the camera between two frames [m], [rad]; more is a slip.
    """

    min_pixels: int = 120
    min_pixels_cut: int = 400
    enough: int = 3
    enough_share: float = 0.6
    seen_before: int = 2
    retry: int = 8
    check_every: int = 4
    max_misses: int = 5
    through_share: float = 0.6
    max_through: int = 2
    max_bad: int = 12
    lost_share: float = 0.5
    weak_move: float = 0.01
    growing_move: float = 0.025
    max_weak: int = 20
    max_blind: int = 10
    max_keyframes: int = 80
    class_margin: float = 4.0
    max_move: float = 0.10
    max_turn: float = np.radians(12.0)


@dataclass(frozen=True)
class SlamConfig:
    """All settings of the system."""

    joint_on: bool = True
    fit: FitConfig = field(default_factory=lambda: FitConfig(refine=None))  # landmarks have no meshes
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
