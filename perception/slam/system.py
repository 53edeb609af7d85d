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
from perception.geometry import invert
from perception.inference.shape_model import Decoder
from perception.pipeline import Device, load_perception
from perception.slam.association import RenderedMasks, associate_masks, render_masks
from perception.slam.config import SlamConfig
from perception.slam.estimates import object_estimates
from perception.slam.keyframes import Keyframe, make_keyframe, shows_new_view, with_pose
from perception.slam.landmarks import LandmarkMap
from perception.slam.mapping import Mapper
from perception.slam.mask_merging import unite_fragments
from perception.slam.motion import Motion
from perception.slam.pixels import TrackingPixels, in_known_parts, label_image, select_pixels
from perception.slam.relocalise import Relocalised, relocalise
from perception.slam.tracking import TrackedPose, track
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

Detect = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]
Clock = Callable[[], float]
Status = Literal["tracked", "weak", "lost"]
Labels = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True)
class FrameResult:
    """What one frame came to.

    Attributes:
        number: of the frame.
        time: its capture time [s].
        T_world_camera: the camera's pose; while lost the best guess.
        status: "tracked", "weak" (few landmarks hold the pose) or "lost".
        spread: standard deviation of the camera's place in the direction that is known least [m].
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
    spread: float = 0.0
    landmark_of: Mapping[int, int] = field(default_factory=dict)
    new: tuple[int, ...] = ()
    retired: tuple[int, ...] = ()
    keyframe: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Seen:
    """A frame's masks, how they fit the map, and where the camera then is.

    ``unknown`` is of each landmark the share of its pixels that no keyframe had in view.
    """

    detections: list[ObjectDetection]
    labels: Labels
    landmark_of: dict[int, int]
    pixels: TrackingPixels
    unknown: dict[int, float]
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
        self._motion: Motion | None = None  # after the last frame whose pose is believed
        self._lost_for = 0
        self._previous: tuple[Labels, dict[int, int]] | None = None
        self._seconds: dict[str, float] = {}

    @staticmethod
    def load(device: Device = "auto", config: SlamConfig | None = None) -> Slam:
        """Return a system with the shipped shape prior and detector.

        Raises:
            PerceptionError: weights are missing or damaged.
        """
        networks = load_perception(device)
        return Slam(networks.decoder, networks.detector, config)

    def object_estimates(self) -> list[ObjectEstimate]:
        """Return the landmarks with their meshes, by id; those without a surface are omitted."""
        return [] if self.world is None else object_estimates(self.world, self.decoder)

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
        assert self._motion is not None
        predicted = self._motion.predicted(frame.time, self.config.motion)
        if self._lost_for:
            return self._find_again(self.mapper, frame, predicted)
        seen = self._look(self.mapper, frame, predicted)
        status, motion = self._judge(seen.tracked, predicted)
        if status == "lost":
            logger.info("frame %d: lost", self._number)
            self._motion = motion or self._motion
            return self._find_again(self.mapper, frame, motion or predicted)
        assert motion is not None
        self._motion = motion
        return self._go_on(self.mapper, frame, seen, status)

    def _begin(self, frame: RgbdFrame) -> FrameResult:
        """The first frame: the plane, and every object in view."""
        T = np.eye(4) if frame.T_world_camera is None else np.array(frame.T_world_camera)
        plane = fit_support_plane([frame])
        mapper = self.mapper = Mapper(plane, self.decoder, self.config)
        self._motion = Motion.at(frame.time, T, self.config.motion)
        posed = with_pose(frame, T)
        with self._timed("detect"):
            detections = unite_fragments(posed, self.detect(posed, plane), plane)
        labels = label_image(detections, frame.depth.shape)
        mapper.unmatched = [(found.mask, self.config.life.seen_before) for found in detections]
        pixels = select_pixels(frame, labels, {}, T, plane, self.config.selection)
        return self._extend_map(mapper, posed, detections, labels, {}, pixels, {}, {}, "tracked", ())

    def _look(
        self, mapper: Mapper, frame: RgbdFrame, predicted: Motion, iterations: int | None = None
    ) -> _Seen:
        """Masks, their landmarks, and the pose that fits."""
        world, config, T_predicted = mapper.world, self.config, predicted.T_world_camera
        tracking = config.tracking if iterations is None else replace(config.tracking, iterations=iterations)
        posed = with_pose(frame, T_predicted)
        with self._timed("detect"):
            detections = unite_fragments(posed, self.detect(posed, world.plane), world.plane)
        with self._timed("track"):
            labels = label_image(detections, frame.depth.shape)
            render = cache(lambda: render_masks(world, frame, T_predicted, config.association.pitch))
            landmark_of = associate_masks(posed, labels, self._previous, render, world, config.association)
            labels, landmark_of = joined_labels(labels, landmark_of)
            pixels = select_pixels(frame, labels, landmark_of, T_predicted, world.plane, config.selection)
            known = in_known_parts(pixels, world, mapper.keyframes, T_predicted)
            unknown = {
                int(one): 1 - float(known[pixels.is_object & (pixels.owner == one)].mean())
                for one in np.unique(pixels.owner[pixels.is_object])
            }
            pixels = pixels.only(known)
            suspects = frozenset(i for i, one in world.landmarks.items() if one.bad >= 2)
            prior = np.linalg.inv(predicted.pose_covariance)
            tracked = track(world, pixels, T_predicted, tracking, suspects, prior)
        return _Seen(detections, labels, landmark_of, pixels, unknown, tracked, render)

    def _go_on(self, mapper: Mapper, frame: RgbdFrame, seen: _Seen, status: Status) -> FrameResult:
        """A believed pose: the landmarks' lives go on, the map may grow."""
        T = seen.tracked.T_world_camera
        looks = self._number % self.config.life.check_every == 0
        rendered = seen.render() if looks else None
        retired = mapper.count(frame, seen.detections, seen.landmark_of, rendered, seen.tracked, self._number)
        landmark_of = {k: one for k, one in seen.landmark_of.items() if one not in retired}
        mapper.remember_unmatched(seen.detections, seen.labels, landmark_of)
        posed = with_pose(frame, T)
        return self._extend_map(
            mapper, posed, seen.detections, seen.labels, landmark_of, seen.pixels, seen.unknown,
            seen.tracked.shares, status, tuple(retired),
        )  # fmt: skip

    def _judge(self, tracked: TrackedPose, predicted: Motion) -> tuple[Status, Motion | None]:
        """Whether the pose can be believed and is known well enough, and the motion with it if it can."""
        life = self.config.life
        slip = invert(predicted.T_world_camera) @ tracked.T_world_camera
        angle = np.arccos(np.clip((np.trace(slip[:3, :3]) - 1) / 2, -1, 1))
        believable = (
            np.isfinite(tracked.T_world_camera).all()
            and tracked.share_of_used >= life.lost_share
            and np.linalg.norm(slip[:3, 3]) < life.max_move
            and angle < life.max_turn
        )
        if not believable:
            return "lost", None
        motion = predicted.told(tracked.T_world_camera, tracked.information)
        if motion.spread > life.lost_spread:
            return "lost", motion
        return "weak" if motion.spread > life.weak_spread else "tracked", motion

    def _find_again(self, mapper: Mapper, frame: RgbdFrame, guess: Motion) -> FrameResult:
        """Near where the camera must be while that is known, else by the map, which is frozen until then."""
        self._lost_for += 1
        if self._lost_for > 1 and guess.spread < self.config.life.search_spread:
            seen = self._look(mapper, frame, guess, iterations=8)
            motion = self._judge(seen.tracked, guess)[1]
            agree = [i for i, share in seen.tracked.shares.items() if share > self.config.life.enough_share]
            if motion is not None and motion.spread < self.config.life.found_spread and len(agree) >= 2:
                return self._found(motion, seen.labels, seen.landmark_of)
            if motion is not None:
                self._motion = guess = motion
        found = self.relocalised(frame)
        if found is not None:
            covariance = np.linalg.inv(found.tracked.information + 1e-3 * np.eye(6))
            T = found.tracked.T_world_camera
            motion = Motion.at(frame.time, T, self.config.motion, covariance, guess.period)
            if motion.spread < self.config.life.found_spread:
                return self._found(motion, found.labels, found.landmark_of)
        self._previous, mapper.unmatched = None, []
        return FrameResult(
            self._number, frame.time, guess.T_world_camera, "lost", guess.spread, seconds=dict(self._seconds)
        )

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

    def _found(self, motion: Motion, labels: Labels, landmark_of: dict[int, int]) -> FrameResult:
        logger.info("frame %d: found again", self._number)
        self._lost_for, self._motion = 0, motion
        self._previous = (labels, landmark_of)
        return FrameResult(
            self._number, motion.time, motion.T_world_camera, "tracked", motion.spread, landmark_of,
            seconds=dict(self._seconds),
        )  # fmt: skip

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
        unknown: Mapping[int, float],
        shares: Mapping[int, float],
        status: Status,
        retired: tuple[int, ...],
    ) -> FrameResult:
        """New landmarks, then perhaps a keyframe with its joint optimisation.

        A weak pose needs new landmarks most, cut ones as well; they share its doubt.
        """
        assert self._motion is not None
        landmark_of = dict(landmark_of)
        held = status == "tracked" and mapper.holds(shares)
        with self._timed("initialise"):
            new = mapper.new_landmarks(posed, detections, landmark_of, held, self._number)
        landmark_of |= new
        self._previous = (labels, landmark_of)
        landmarks = mapper.world.landmarks
        seen = {one: landmarks[one] for one in landmark_of.values() if one in landmarks}
        T = np.array(posed.T_world_camera)
        is_keyframe = (
            bool(new)
            or (status == "tracked" and shows_new_view(T, seen, mapper.keyframes))
            or mapper.completes(detections, landmark_of, unknown, status == "weak", self._number)
        )
        if is_keyframe:
            covariance = self._motion.pose_covariance
            key = make_keyframe(self._number, posed, T, labels, landmark_of, detections, covariance)
            mapper.keep(key, pixels.plane_points, new.values())
            with self._timed("initialise"):
                key = mapper.mend(key, unknown)
            if self.config.joint_on:
                with self._timed("joint"):
                    moved = mapper.optimise(key)
                self._motion = self._motion.moved(moved)  # goes on from there
        return FrameResult(
            self._number, posed.time, self._motion.T_world_camera, status, self._motion.spread, landmark_of,
            tuple(new.values()), retired, is_keyframe, dict(self._seconds),
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
