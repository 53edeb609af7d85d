"""Object-level SLAM, frame by frame: associate, track, map, optimise. Read ``Slam.process`` first.

    frame + masks -> which landmark is which mask -> camera pose -> new landmarks, keyframe? -> joint step

NodeSLAM, section "Object-Level SLAM System".
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from perception.errors import PerceptionError
from perception.geometry import invert, se3_exp, se3_log
from perception.inference.shape_model import Decoder
from perception.slam.association import RenderedMasks, associate_masks, render_masks
from perception.slam.config import SlamConfig
from perception.slam.fragments import unite_fragments
from perception.slam.keyframes import Keyframe, make_keyframe, shows_new_view, with_pose
from perception.slam.landmarks import LandmarkMap
from perception.slam.mapping import Mapper
from perception.slam.pixels import TrackingPixels, label_image, select_pixels
from perception.slam.relocalise import Relocalised, relocalise
from perception.slam.tracking import TrackedPose, TrackingConfig, track
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

Detect = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]
Clock = Callable[[], float]
Status = Literal["tracked", "weak", "lost"]
Labels = UInt8[np.ndarray, "h w"]
_NO_MOTION = 5.0  # times the uncertainty of an even motion: nothing is known but the last pose
_LONGEST_GAP = 5.0  # times the usual period: a motion is not carried on over more


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


@dataclass(frozen=True)
class _Seen:
    """A frame's masks, how they fit the map, and where the camera then is."""

    detections: list[ObjectDetection]
    labels: Labels
    landmark_of: dict[int, int]
    pixels: TrackingPixels
    tracked: TrackedPose
    render: Callable[[], RenderedMasks]


class Slam:
    """Map and camera over a sequence. The first frame's pose defines the world (the identity if unknown)."""

    def __init__(
        self,
        decoder: Decoder,
        detect: Detect,
        config: SlamConfig | None = None,
        clock: Clock = time.perf_counter,
    ) -> None:
        self.decoder, self.detect, self.config, self._now = decoder, detect, config or SlamConfig(), clock
        self.mapper: Mapper | None = None
        self._number = -1
        self._moments: list[tuple[float, np.ndarray]] = []  # times and poses of the last two frames
        self._lost_for = 0
        self._weak_for = 0
        self._may_grow = True
        self._previous: tuple[Labels, dict[int, int]] | None = None
        self._seconds: dict[str, float] = {}

    @property
    def world(self) -> LandmarkMap | None:
        """The map; None before the first frame."""
        return self.mapper.world if self.mapper else None

    @property
    def keyframes(self) -> list[Keyframe]:
        return self.mapper.keyframes if self.mapper else []

    def process(self, frame: RgbdFrame) -> FrameResult:
        """The next frame. Its own pose is ignored, unless it is the first."""
        self._number += 1
        self._seconds = {}
        if self.mapper is None:
            return self._begin(frame)
        if self._lost_for:
            return self._find_again(frame)
        T_predicted = self._predicted(frame.time)
        tracking = self.config.tracking.loosened(self._doubt(frame.time))
        seen = self._look(self.mapper, frame, T_predicted, tracking)
        status = self._judge(seen.tracked, T_predicted)
        if status == "lost":
            logger.info("frame %d: lost", self._number)
            return self._find_again(frame)
        return self._go_on(self.mapper, frame, seen, status)

    def _begin(self, frame: RgbdFrame) -> FrameResult:
        """The first frame: the plane, and every object in view."""
        T = np.eye(4) if frame.T_world_camera is None else np.array(frame.T_world_camera)
        plane = fit_support_plane([frame])
        mapper = self.mapper = Mapper(plane, self.decoder, self.config)
        self._moments = [(frame.time, T)]
        posed = with_pose(frame, T)
        with self._timed("detect"):
            detections = unite_fragments(posed, self.detect(posed, plane), plane)
        labels = label_image(detections, frame.depth.shape)
        mapper.unmatched = [(found.mask, self.config.life.seen_before) for found in detections]
        pixels = select_pixels(frame, labels, {}, T, plane, self.config.selection)
        return self._extend_map(mapper, posed, detections, labels, {}, pixels, {}, "tracked", ())

    def _predicted(self, now: float) -> np.ndarray:
        """Constant velocity, over the time since the last frame."""
        (*_, (t1, T1)) = self._moments
        if len(self._moments) < 2 or t1 <= self._moments[0][0]:
            return T1
        t0, T0 = self._moments[0]
        share = float(np.clip((now - t1) / (t1 - t0), 0.0, _LONGEST_GAP))
        return T1 @ se3_exp(share * se3_log(invert(T0) @ T1))

    def _doubt(self, now: float) -> float:
        """How much less sure a predicted pose is than after an even step of a known motion."""
        if len(self._moments) < 2:
            return _NO_MOTION
        (t0, _), (t1, _) = self._moments
        return float(np.clip(((now - t1) / max(t1 - t0, 1e-6)) ** 2, 1.0, _NO_MOTION))

    def _look(
        self, mapper: Mapper, frame: RgbdFrame, T_predicted: np.ndarray, tracking: TrackingConfig
    ) -> _Seen:
        """Masks, their landmarks, and the pose that fits."""
        world, config = mapper.world, self.config
        posed = with_pose(frame, T_predicted)
        with self._timed("detect"):
            detections = unite_fragments(posed, self.detect(posed, world.plane), world.plane)
        with self._timed("track"):
            labels = label_image(detections, frame.depth.shape)
            render = cache(lambda: render_masks(world, frame, T_predicted, config.association.pitch))
            landmark_of = associate_masks(posed, labels, self._previous, render, world, config.association)
            labels, landmark_of = joined_labels(labels, landmark_of)
            pixels = select_pixels(frame, labels, landmark_of, T_predicted, world.plane, config.selection)
            suspects = frozenset(i for i, one in world.landmarks.items() if one.bad >= 2)
            tracked = track(world, pixels, T_predicted, tracking, suspects)
        return _Seen(detections, labels, landmark_of, pixels, tracked, render)

    def _go_on(self, mapper: Mapper, frame: RgbdFrame, seen: _Seen, status: Status) -> FrameResult:
        """A believed pose: the landmarks' lives go on, the map may grow."""
        T = seen.tracked.T_world_camera
        self._moments = [self._moments[-1], (frame.time, T)]
        looks = self._number % self.config.life.check_every == 0
        rendered = seen.render() if looks else None
        retired = mapper.count(frame, seen.detections, seen.landmark_of, rendered, seen.tracked, self._number)
        landmark_of = {k: one for k, one in seen.landmark_of.items() if one not in retired}
        mapper.remember_unmatched(seen.detections, seen.labels, landmark_of)
        posed = with_pose(frame, T)
        return self._extend_map(
            mapper, posed, seen.detections, seen.labels, landmark_of, seen.pixels, seen.tracked.shares,
            status, tuple(retired),
        )  # fmt: skip

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
        self._weak_for = self._weak_for + 1 if spread > life.weak_move else 0
        self._may_grow = spread < life.growing_move
        if self._weak_for > life.max_weak:
            return "lost"
        return "weak" if self._weak_for else "tracked"

    def _find_again(self, frame: RgbdFrame) -> FrameResult:
        """Near the last pose while that is fresh, else by the map, which is frozen until one succeeds."""
        mapper = self.mapper
        assert mapper is not None
        self._lost_for += 1
        T_last = self._moments[-1][1]
        if 1 < self._lost_for <= self.config.life.max_blind and self._weak_for == 0:
            nearby = replace(self.config.tracking.loosened(_NO_MOTION), iterations=8)
            seen = self._look(mapper, frame, T_last, nearby)
            agree = [i for i, share in seen.tracked.shares.items() if share > 0.6]
            if self._judge(seen.tracked, T_last) == "tracked" and len(agree) >= 2:
                return self._found(frame, seen.tracked, seen.labels, seen.landmark_of)
        found = self.relocalised(frame)
        if found is not None:
            return self._found(frame, found.tracked, found.labels, found.landmark_of)
        self._previous, mapper.unmatched = None, []
        return FrameResult(self._number, frame.time, T_last, "lost", seconds=dict(self._seconds))

    def relocalised(self, frame: RgbdFrame) -> Relocalised | None:
        """Where the map says that a frame from nobody knows where was taken; changes nothing."""
        assert self.world is not None
        with self._timed("detect"):
            detections = self._detect_unposed(frame)
        with self._timed("relocalise"):
            return relocalise(
                self.world, frame, detections, label_image(detections, frame.depth.shape),
                self.config.tracking, self.config.selection, self.config.relocalisation,
            )  # fmt: skip

    def _found(
        self, frame: RgbdFrame, tracked: TrackedPose, labels: Labels, landmark_of: dict[int, int]
    ) -> FrameResult:
        logger.info("frame %d: found again", self._number)
        self._lost_for, self._weak_for = 0, 0
        self._moments = [(frame.time, tracked.T_world_camera)]
        self._previous = (labels, landmark_of)
        return FrameResult(
            self._number,
            frame.time,
            tracked.T_world_camera,
            "tracked",
            landmark_of,
            seconds=dict(self._seconds),
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Adds the seconds of a block to the frame's."""
        begin = self._now()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + self._now() - begin

    def _detect_unposed(self, frame: RgbdFrame) -> list[ObjectDetection]:
        """Detections of a frame from nobody knows where: the plane is found in the frame itself."""
        bare = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)
        try:
            plane = fit_support_plane([bare])
            return unite_fragments(bare, self.detect(bare, plane), plane)
        except PerceptionError:
            return []

    def _extend_map(
        self,
        mapper: Mapper,
        posed: RgbdFrame,
        detections: Sequence[ObjectDetection],
        labels: Labels,
        landmark_of: Mapping[int, int],
        pixels: TrackingPixels,
        shares: Mapping[int, float],
        status: Status,
        retired: tuple[int, ...],
    ) -> FrameResult:
        """New landmarks, then perhaps a keyframe with its joint optimisation.

        A weak pose needs new landmarks most: while it is not too weak they are taken, cut ones as well.
        """
        landmark_of = dict(landmark_of)
        new: dict[int, int] = {}
        if self._may_grow:
            held = status == "tracked" and mapper.holds(shares)
            with self._timed("initialise"):
                new = mapper.new_landmarks(posed, detections, landmark_of, held, self._number)
        landmark_of |= new
        self._previous = (labels, landmark_of)
        landmarks = mapper.world.landmarks
        seen = {one: landmarks[one] for one in landmark_of.values() if one in landmarks}
        T = np.array(posed.T_world_camera)
        is_new = status == "tracked" and shows_new_view(T, seen, mapper.keyframes)
        is_keyframe = bool(new) or is_new
        if is_keyframe:
            key = make_keyframe(self._number, posed, T, labels, landmark_of, detections)
            mapper.keep(key, pixels.plane_points)
            with self._timed("initialise"):
                mapper.refit_doubtful(key)
            if self.config.joint_on:
                with self._timed("joint"):
                    moved = mapper.optimise(key)
                self._moments = [
                    (t, moved @ pose) for t, pose in self._moments
                ]  # the motion goes on from there
        return FrameResult(
            self._number, posed.time, self._moments[-1][1], status, landmark_of, tuple(new.values()), retired,
            is_keyframe, dict(self._seconds),
        )  # fmt: skip


def joined_labels(
    labels: UInt8[np.ndarray, "h w"], landmark_of: Mapping[int, int]
) -> tuple[UInt8[np.ndarray, "h w"], dict[int, int]]:
    """One label for each landmark: the parts of one take the first part's."""
    main: dict[int, int] = {}
    table = np.arange(256, dtype=np.uint8)
    for label, one in landmark_of.items():
        table[label] = main.setdefault(one, label)
    return table[labels], {label: one for one, label in main.items()}
