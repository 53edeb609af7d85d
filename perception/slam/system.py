"""Object-level SLAM, frame by frame: associate, track, map, optimise. Read ``Slam.process`` first.

    frame + masks -> which landmark is which mask -> camera pose -> new landmarks, keyframe? -> joint step

NodeSLAM, section "Object-Level SLAM System".
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from perception.geometry import invert
from perception.inference.fit import FitConfig
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import hidden_by
from perception.inference.shape_model import Decoder
from perception.slam.association import (
    AssociationConfig,
    RenderedMasks,
    associate_masks,
    render_masks,
)
from perception.slam.fragments import unite_fragments
from perception.slam.initialise import initialise_landmark
from perception.slam.joint import JointConfig, optimise_jointly
from perception.slam.keyframes import Keyframe, make_keyframe, shows_new_view, window_of, with_pose
from perception.slam.landmarks import Landmark, LandmarkMap
from perception.slam.pixels import SelectionConfig, TrackingPixels, label_image, select_pixels
from perception.slam.relocalise import RelocalisationConfig, relocalise
from perception.slam.tracking import TrackedPose, TrackingConfig, track
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

Detect = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]
Status = Literal["tracked", "weak", "lost"]


@dataclass(frozen=True)
class LifeConfig:
    """When landmarks come and go, and when the camera is lost.

    Attributes:
        min_pixels: of a mask that a landmark is made from.
        min_share: of a new landmark's pixels that must agree with it.
        seen_before: frames in a row that must show an unmatched mask before it becomes a landmark.
        retry: frames until an object that could not be initialised is tried again.
        check_every: so many frames it is looked which landmarks should be seen.
        max_misses: such looks in a row at which a landmark should be seen but is not.
        max_bad: frames in a row in which most of its pixels disagree.
        lost_share: median share of agreeing pixels under which the camera is lost.
        weak_move: standard deviation of the camera's place from which on the pose is weak [m].
        max_weak: weak frames in a row after which the camera counts as lost.
        max_move, max_turn: of the camera between two frames [m], [rad]; more is a slip.
    """

    min_pixels: int = 120
    min_share: float = 0.5
    seen_before: int = 2
    retry: int = 8
    check_every: int = 4
    max_misses: int = 5
    max_bad: int = 12
    lost_share: float = 0.5
    weak_move: float = 0.01
    max_weak: int = 20
    max_move: float = 0.10
    max_turn: float = np.radians(12.0)


@dataclass(frozen=True)
class SlamConfig:
    """All settings of the system."""

    joint_on: bool = True
    fit: FitConfig = field(default_factory=FitConfig)
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


@dataclass(frozen=True)
class FrameResult:
    """What one frame came to.

    Attributes:
        number: of the frame.
        time: its capture time [s].
        T_world_camera: the camera's pose; the last known one while lost.
        status: "tracked", "weak" (few landmarks hold the pose) or "lost".
        landmark_of: label (1 + index of the detection) to landmark.
        new: landmarks initialised here.
        retired: landmarks given up here.
        keyframe: whether it was kept.
        seconds: of detection, tracking (association, pixels, pose), initialisation and joint optimisation.
    """

    number: int
    time: float
    T_world_camera: Float[np.ndarray, "4 4"]
    status: Status
    landmark_of: Mapping[int, int] = field(default_factory=dict)
    new: tuple[int, ...] = ()
    retired: tuple[int, ...] = ()
    keyframe: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)


class Slam:
    """Map and camera over a sequence. The first frame's pose defines the world (the identity if unknown)."""

    def __init__(self, decoder: Decoder, detect: Detect, config: SlamConfig | None = None) -> None:
        self.decoder, self.detect, self.config = decoder, detect, config or SlamConfig()
        self.world: LandmarkMap | None = None
        self.keyframes: list[Keyframe] = []
        self._plane_points: dict[int, np.ndarray] = {}  # of each keyframe
        self._number = -1
        self._poses: list[np.ndarray] = []  # of the last two frames, if both are known
        self._lost = False
        self._weak_frames = 0
        self._previous: tuple[np.ndarray, dict[int, int]] | None = None
        self._unmatched: list[tuple[np.ndarray, int]] = []  # masks of no landmark, and for how many frames
        self._failed: dict[int, int] = {}
        self._next_id = 0
        self._clock: dict[str, float] = {}

    def process(self, frame: RgbdFrame) -> FrameResult:
        """The next frame. Its own pose is ignored, unless it is the first."""
        self._number += 1
        self._clock = {}
        if self.world is None:
            return self._begin(frame)
        T_predicted = self._predicted()
        if self._lost:
            return self._find_again(frame)
        return self._follow(frame, T_predicted)

    def _begin(self, frame: RgbdFrame) -> FrameResult:
        """The first frame: the plane, and every object in view."""
        T = np.eye(4) if frame.T_world_camera is None else np.array(frame.T_world_camera)
        plane = fit_support_plane([with_pose(frame, T)] if frame.T_world_camera is not None else [frame])
        self.world = LandmarkMap(plane)
        self._poses = [T]
        posed = with_pose(frame, T)
        with _timed(self._clock, "detect"):
            detections = unite_fragments(posed, self.detect(posed, plane), plane)
        labels = label_image(detections, frame.depth.shape)
        self._unmatched = [(found.mask, self.config.life.seen_before) for found in detections]
        pixels = select_pixels(frame, labels, {}, T, plane, self.config.selection)
        return self._extend_map(posed, detections, labels, {}, pixels, "tracked", ())

    def _predicted(self) -> np.ndarray:
        """Constant velocity."""
        if len(self._poses) < 2:
            return self._poses[-1]
        T = self._poses[-1] @ invert(self._poses[-2]) @ self._poses[-1]
        u, _, vt = np.linalg.svd(T[:3, :3])
        T[:3, :3] = u @ vt
        return T

    def _follow(self, frame: RgbdFrame, T_predicted: np.ndarray) -> FrameResult:
        world, config = self.world, self.config
        assert world is not None
        posed = with_pose(frame, T_predicted)
        with _timed(self._clock, "detect"):
            detections = unite_fragments(posed, self.detect(posed, world.plane), world.plane)
        with _timed(self._clock, "track"):
            labels = label_image(detections, frame.depth.shape)
            render = cache(lambda: render_masks(world, frame, T_predicted, config.association.pitch))
            landmark_of = associate_masks(posed, labels, self._previous, render, world, config.association)
            labels, landmark_of = joined_labels(labels, landmark_of)
            pixels = select_pixels(frame, labels, landmark_of, T_predicted, world.plane, config.selection)
            suspects = frozenset(i for i, one in world.landmarks.items() if one.bad >= 2)
            tracked = track(world, pixels, T_predicted, config.tracking, suspects)
        status = self._judge(tracked, T_predicted)
        if status == "lost":
            self._lost = True
            logger.info("frame %d: lost", self._number)
            return self._find_again(frame, detections, labels)
        self._poses = [self._poses[-1], tracked.T_world_camera]
        checks = self._number % config.life.check_every == 0
        retired = self._count(detections, landmark_of, render() if checks else None, tracked)
        landmark_of = {k: one for k, one in landmark_of.items() if one not in retired}
        self._remember_unmatched(detections, labels, landmark_of)
        self._previous = (labels, landmark_of)
        posed = with_pose(frame, tracked.T_world_camera)
        return self._extend_map(posed, detections, labels, landmark_of, pixels, status, tuple(retired))

    def _judge(self, tracked: TrackedPose, T_predicted: np.ndarray) -> Status:
        """Whether the pose can be believed."""
        life = self.config.life
        slip = invert(T_predicted) @ tracked.T_world_camera
        angle = np.arccos(np.clip((np.trace(slip[:3, :3]) - 1) / 2, -1, 1))
        believable = (
            np.isfinite(tracked.T_world_camera).all()
            and tracked.share >= life.lost_share
            and np.linalg.norm(slip[:3, 3]) < life.max_move
            and angle < life.max_turn
        )
        if not believable:
            return "lost"
        covariance = np.linalg.pinv(tracked.information + 1e-6 * np.eye(6), hermitian=True)
        spread = float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0)))
        self._weak_frames = self._weak_frames + 1 if spread > life.weak_move else 0
        if self._weak_frames > life.max_weak:
            return "lost"
        return "weak" if self._weak_frames else "tracked"

    def _find_again(
        self,
        frame: RgbdFrame,
        detections: Sequence[ObjectDetection] | None = None,
        labels: np.ndarray | None = None,
    ) -> FrameResult:
        """Relocalisation by the map, which stays as it is until that succeeds."""
        assert self.world is not None
        if detections is None or labels is None:
            with _timed(self._clock, "detect"):
                detections = self._detect_unposed(frame)
            labels = label_image(detections, frame.depth.shape)
        with _timed(self._clock, "relocalise"):
            found = relocalise(
                self.world, frame, detections, labels,
                self.config.tracking, self.config.selection, self.config.relocalisation,
            )  # fmt: skip
        self._previous, self._unmatched = None, []
        if found is None:
            return FrameResult(self._number, frame.time, self._poses[-1], "lost", seconds=dict(self._clock))
        logger.info("frame %d: found again", self._number)
        self._lost, self._weak_frames = False, 0
        self._poses = [found.tracked.T_world_camera]
        self._previous = (labels, found.landmark_of)
        return FrameResult(
            self._number, frame.time, found.tracked.T_world_camera, "tracked", found.landmark_of,
            seconds=dict(self._clock),
        )  # fmt: skip

    def _detect_unposed(self, frame: RgbdFrame) -> list[ObjectDetection]:
        """Detections of a frame from nobody knows where: the plane is found in the frame itself."""
        from perception.errors import PerceptionError

        bare = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)
        try:
            plane = fit_support_plane([bare])
            return unite_fragments(bare, self.detect(bare, plane), plane)
        except PerceptionError:
            return []

    def _count(
        self,
        detections: Sequence[ObjectDetection],
        landmark_of: Mapping[int, int],
        rendered: RenderedMasks | None,
        tracked: TrackedPose,
    ) -> set[int]:
        """Votes, hits and misses of the landmarks; those that are to go are taken out and returned."""
        assert self.world is not None
        life, changed = self.config.life, []
        label_of = {one: label for label, one in landmark_of.items()}
        best = max(tracked.shares.values(), default=0.0)
        for one, landmark in self.world.landmarks.items():
            if one in label_of:
                landmark = landmark.voted(detections[label_of[one] - 1])
                if one in tracked.shares:
                    poor = tracked.shares[one] < self.config.tracking.outcast * best
                    landmark = replace(landmark, bad=landmark.bad + 1 if poor else 0)
            elif rendered and rendered.visible.get(one, 0) * rendered.pitch**2 > 2 * life.min_pixels:
                open_share = rendered.visible[one] / max(rendered.whole[one], 1)
                landmark = replace(landmark, misses=landmark.misses + (open_share > 0.6))
            changed.append(landmark)
        retired = {x.id for x in changed if x.misses > life.max_misses or x.bad > life.max_bad}
        self.world = self.world.with_landmarks(*changed)
        if retired:
            logger.info("frame %d: retired %s", self._number, sorted(retired))
            self.world = self.world.without(retired)
        return retired

    def _remember_unmatched(
        self, detections: Sequence[ObjectDetection], labels: np.ndarray, landmark_of: Mapping[int, int]
    ) -> None:
        """For how many frames each mask without a landmark has been there."""
        now = []
        present = np.bincount(labels.ravel(), minlength=256) > 0
        for label, found in enumerate(detections, start=1):
            if label in landmark_of or not present[label]:  # a part that went into another's label
                continue
            before = [
                count
                for mask, count in self._unmatched
                if (mask & found.mask).sum() > 0.2 * (mask | found.mask).sum()
            ]
            now.append((found.mask, 1 + max(before, default=0)))
        self._unmatched = now

    def _extend_map(
        self,
        posed: RgbdFrame,
        detections: Sequence[ObjectDetection],
        labels: np.ndarray,
        landmark_of: Mapping[int, int],
        pixels: TrackingPixels,
        status: Status,
        retired: tuple[int, ...],
    ) -> FrameResult:
        """New landmarks, then perhaps a keyframe with its joint optimisation."""
        assert self.world is not None
        landmark_of = dict(landmark_of)
        new: dict[int, int] = {}
        if status == "tracked":
            with _timed(self._clock, "initialise"):
                new = self._new_landmarks(posed, detections, landmark_of)
        landmark_of |= new
        self._previous = (labels, landmark_of)
        seen = {one: self.world.landmarks[one] for one in landmark_of.values() if one in self.world.landmarks}
        T = np.array(posed.T_world_camera)
        is_keyframe = status == "tracked" and (bool(new) or shows_new_view(T, seen, self.keyframes))
        if is_keyframe:
            key = make_keyframe(self._number, posed, T, labels, landmark_of, detections)
            self.keyframes.append(key)
            self._plane_points[self._number] = pixels.plane_points
            if self.config.joint_on:
                with _timed(self._clock, "joint"):
                    self._optimise(key)
        return FrameResult(
            self._number, posed.time, self._poses[-1], status, landmark_of, tuple(new.values()), retired,
            is_keyframe, dict(self._clock),
        )  # fmt: skip

    def _new_landmarks(
        self, posed: RgbdFrame, detections: Sequence[ObjectDetection], landmark_of: Mapping[int, int]
    ) -> dict[int, int]:
        """Landmarks from masks that have had none for a while."""
        assert self.world is not None
        life, new = self.config.life, {}
        ages = {id(mask): age for mask, age in self._unmatched}
        for label, found in enumerate(detections, start=1):
            age = ages.get(id(found.mask), 0)
            waits = age < life.seen_before or (age - life.seen_before) % life.retry
            if label in landmark_of or waits or found.mask.sum() < life.min_pixels:
                continue
            landmark = self._initialise(posed, detections, found)
            if landmark is not None:
                self.world = self.world.with_landmarks(landmark)
                new[label] = landmark.id
                self._next_id += 1
        return new

    def _initialise(
        self, posed: RgbdFrame, detections: Sequence[ObjectDetection], found: ObjectDetection
    ) -> Landmark | None:
        assert self.world is not None
        others = [other.mask for other in detections if other is not found]
        ignore = hidden_by(posed, found.mask, others)
        seen = ObjectObservation(posed, found.mask, ignore, found.yaw_probabilities)
        landmark = initialise_landmark(
            [seen], found, self.decoder, self.world.plane, self.config.fit, self._next_id, self._number
        )
        if landmark is None or self._overlaps(landmark):
            return None
        return landmark

    def _overlaps(self, landmark: Landmark) -> bool:
        """Whether another landmark stands where this one would."""
        assert self.world is not None
        place = landmark.state.pose.translation
        return any(
            np.linalg.norm(one.state.pose.translation - place) < 0.35 * (one.reach + landmark.reach)
            for one in self.world.landmarks.values()
        )

    def _optimise(self, key: Keyframe) -> None:
        """The newest keyframe with its nearest ones; where it moves, tracking goes on from there."""
        assert self.world is not None
        window = window_of(key, self.keyframes, self.world.landmarks, self.config.joint.window)
        result = optimise_jointly(
            window, self.world.landmarks, self.decoder, self.world.plane,
            [self._plane_points[k.number] for k in window], self.config.joint,
        )  # fmt: skip
        self.world = self.world.with_landmarks(*result.landmarks.values())
        moved = {k.number: k for k in result.keyframes}
        self.keyframes = [moved.get(k.number, k) for k in self.keyframes]
        before, after = self._poses[-1], moved[key.number].T_world_camera
        if len(self._poses) == 2:  # the last motion goes on from the corrected pose
            self._poses[0] = after @ invert(before) @ self._poses[0]
        self._poses[-1] = np.array(after)


def joined_labels(
    labels: UInt8[np.ndarray, "h w"], landmark_of: Mapping[int, int]
) -> tuple[UInt8[np.ndarray, "h w"], dict[int, int]]:
    """One label for each landmark: the parts of one take the first part's."""
    main: dict[int, int] = {}
    table = np.arange(256, dtype=np.uint8)
    for label, one in landmark_of.items():
        table[label] = main.setdefault(one, label)
    return table[labels], {label: one for one, label in main.items()}


class _timed:
    """Adds the seconds of a block to a dictionary."""

    def __init__(self, clock: dict[str, float], name: str) -> None:
        self._clock, self._name = clock, name

    def __enter__(self) -> None:
        self._begin = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._clock[self._name] = self._clock.get(self._name, 0.0) + time.perf_counter() - self._begin
