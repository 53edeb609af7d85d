"""Object-level SLAM, frame by frame. ``Slam.process`` is the place to start reading.

    frame + masks -> data association -> camera pose -> new landmarks, keyframe -> joint optimisation

Masks come from the detector on keyframes and where the map does not explain what the frame shows
(``detection_schedule``); between, they are rendered from the map (``mask_tracking``). Joint optimisation runs
beside tracking and is applied a fixed number of frames later.

NodeSLAM, section "Object-Level SLAM System".
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np
from jaxtyping import Float

from perception.errors import PerceptionError
from perception.inference.reconstruct import single_threaded_torch
from perception.inference.shape_model import Decoder
from perception.pipeline import Device, load_perception
from perception.slam.association import associate_masks, render_masks
from perception.slam.bundle_adjustment import optimise_jointly
from perception.slam.bundle_window import BundleResult
from perception.slam.config import SlamConfig
from perception.slam.detection_schedule import DetectionSchedule
from perception.slam.estimates import object_estimates
from perception.slam.frame_tracking import TrackedFrame, track_view
from perception.slam.joint_worker import DelayedJob
from perception.slam.keyframes import Keyframe, is_new_viewpoint
from perception.slam.labelled_frame import LabelledFrame, with_pose
from perception.slam.landmarks import LandmarkMap
from perception.slam.mapping import Mapper
from perception.slam.mask_merging import merge_masks
from perception.slam.mask_tracking import track_masks
from perception.slam.motion import CameraMotion
from perception.slam.pixels import select_pixels
from perception.slam.pose_check import Status, check_pose
from perception.slam.relocalise import Relocalisation, relocalise
from perception.support_plane import fit_support_plane
from perception.types import ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)

Detect = Callable[[RgbdFrame, SupportPlane], Sequence[ObjectDetection]]
Clock = Callable[[], float]

_SEARCH_ITERATIONS = 8  # of tracking near the predicted pose of a lost camera
_SEARCH_MIN_LANDMARKS = 2  # that must agree there
_MIN_INFORMATION = 1e-3  # [1/rad^2], [1/m^2] added to a relocalised pose's, to keep it invertible


@dataclass(frozen=True)
class FrameResult:
    """Result of tracking one frame.

    Attributes:
        number: Index of the frame in the sequence.
        time: Capture time, in seconds.
        T_world_camera: Estimated camera pose; the prediction while the camera is lost.
        status: "tracked", "weak" (large position uncertainty) or "lost".
        position_std: Standard deviation of the camera position along its least certain direction, in metres.
        landmark_of: Landmark id of each associated label of the frame's masks.
        is_detected: Whether the masks are of the detector; otherwise they are rendered from the map.
        new: Ids of the landmarks initialised in this frame.
        retired: Ids of the landmarks removed in this frame.
        is_keyframe: Whether the frame became a keyframe.
        seconds: Duration of each stage: detect, track, initialise, joint, relocalise.
    """

    number: int
    time: float
    T_world_camera: Float[np.ndarray, "4 4"]
    status: Status
    position_std: float = 0.0
    landmark_of: Mapping[int, int] = field(default_factory=dict)
    is_detected: bool = False
    new: tuple[int, ...] = ()
    retired: tuple[int, ...] = ()
    is_keyframe: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)


class Slam:
    """Map and camera over a sequence; the first frame's pose defines the world (identity if unknown)."""

    def __init__(
        self,
        decoder: Decoder,
        detect: Detect,
        config: SlamConfig | None = None,
        clock: Clock = time.perf_counter,
    ) -> None:
        """Start with an empty map.

        Args:
            decoder: Shape prior.
            detect: Returns the detections of a frame, given the support plane.
            config: Settings.
            clock: Time in seconds, for the durations of the stages.
        """
        self.decoder, self.detect, self.config, self._now = decoder, detect, config or SlamConfig(), clock
        self.mapper: Mapper | None = None
        self._number = -1
        self._motion: CameraMotion | None = None  # after the last frame whose pose was accepted
        self._n_lost = 0  # successive lost frames
        self._previous: LabelledFrame | None = None
        self._seconds: dict[str, float] = {}
        self._schedule = DetectionSchedule(self.config.detection)
        self._checked = 0  # number of the last frame with a visibility check
        self._joint: DelayedJob[BundleResult] = DelayedJob(self.config.concurrent)

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
        self.finish()
        return [] if self.world is None else object_estimates(self.world, self.decoder)

    def finish(self) -> None:
        """Apply the joint optimisation in progress, as at the end of a sequence."""
        if self._joint.due is not None and self.mapper is not None:
            with self._timed("joint"):
                self._take_joint(self.mapper)

    @property
    def world(self) -> LandmarkMap | None:
        """The map; None before the first frame."""
        return self.mapper.world if self.mapper else None

    @property
    def keyframes(self) -> list[Keyframe]:
        """Keyframes, oldest first."""
        return self.mapper.keyframes if self.mapper else []

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Track the camera in the next frame and update the map.

        The frame's own pose is ignored, except that of the first.
        """
        with single_threaded_torch():  # objects are fitted in parallel, one thread each
            return self._process(frame)

    def _process(self, frame: RgbdFrame) -> FrameResult:
        self._number += 1
        self._seconds = {}
        if self.mapper is None:
            return self._initialise_map(frame)
        if self._joint.due is not None and self._number >= self._joint.due:
            self.finish()
        assert self._motion is not None
        predicted = self._motion.predict(frame.time, self.config.motion)
        if self._n_lost:
            return self._recover(self.mapper, frame, predicted)
        mapper, schedule = self.mapper, self._schedule
        if not schedule.is_due(self._number, mapper.needs_detections, mapper.verifies_absence):
            followed = self._follow(mapper, frame, predicted)
            if followed is not None:
                return followed
            interval = self.config.lifecycle.visibility_interval
            self._checked = min(self._checked, self._number - interval)  # check what is doubtful at once
        tracked = self._track_frame(self.mapper, frame, predicted)
        status, motion = check_pose(tracked.tracked, predicted, self.config.pose_check)
        if status == "lost":
            logger.info("frame %d: lost", self._number)
            self._motion = motion or self._motion
            return self._recover(self.mapper, frame, motion or predicted)
        assert motion is not None
        self._motion = motion
        return self._update_map(self.mapper, tracked, status)

    def _initialise_map(self, frame: RgbdFrame) -> FrameResult:
        """Fit the support plane and every object of the first frame."""
        T = np.eye(4) if frame.T_world_camera is None else np.array(frame.T_world_camera)
        plane = fit_support_plane([frame])
        mapper = self.mapper = Mapper(plane, self.decoder, self.config)
        self._motion = CameraMotion.with_unknown_velocity(frame.time, T, self.config.motion)
        posed = with_pose(frame, T)
        with self._timed("detect"):
            detections = merge_masks(posed, self.detect(posed, plane), plane, self.config.merging)
        view = LabelledFrame.of(self._number, posed, detections)
        mapper.set_unmatched(view)
        pixels = select_pixels(view, plane, self.config.pixels)
        return self._extend_map(mapper, view, pixels.plane_points, {}, "tracked", False)

    def _follow(self, mapper: Mapper, frame: RgbdFrame, predicted: CameraMotion) -> FrameResult | None:
        """Track with masks rendered from the map, which stays as it is; None if detections are needed."""
        config, T_predicted = self.config, predicted.T_world_camera
        with self._timed("track"):
            rendered = render_masks(mapper.world, frame, T_predicted, config.association.pitch)
            posed = with_pose(frame, T_predicted)
            masks = track_masks(self._number, posed, rendered, mapper.world.plane, config.mask_tracking)
            result = track_view(mapper, masks.view, predicted, lambda: rendered, config)
            tracked = result.tracked
            status, motion = check_pose(tracked, predicted, config.pose_check)
            if status != "tracked" or motion is None:
                return None
            ratios = tracked.inlier_ratios
            if self._schedule.is_doubtful(masks, tracked.median_inlier_ratio_of_used, ratios):
                return None
            view = masks.view.with_pose(tracked.T_world_camera)
            if self._schedule.allows_keyframe(self._number) and self._contributes(
                mapper, view, result.unseen_ratios, status
            ):
                return None
        self._motion, self._previous = motion, view
        return replace(self._result(motion, status), landmark_of=view.landmark_of)

    def _track_frame(
        self, mapper: Mapper, frame: RgbdFrame, predicted: CameraMotion, iterations: int | None = None
    ) -> TrackedFrame:
        """Detect, associate and track; ``iterations`` overrides the config's."""
        world, config, T_predicted = mapper.world, self.config, predicted.T_world_camera
        posed = with_pose(frame, T_predicted)
        self._schedule.detected(self._number)
        with self._timed("detect"):
            detections = merge_masks(posed, self.detect(posed, world.plane), world.plane, config.merging)
        with self._timed("track"):
            view = LabelledFrame.of(self._number, posed, detections)
            render = cache(lambda: render_masks(world, frame, T_predicted, config.association.pitch))
            view = view.associated(associate_masks(view, self._previous, render, world, config.association))
            return track_view(mapper, view, predicted, render, config, iterations)

    def _update_map(self, mapper: Mapper, result: TrackedFrame, status: Status) -> FrameResult:
        """Update the landmarks after a frame with an accepted pose, and extend the map."""
        tracked, view = result.tracked, result.view
        check_visibility = self._number - self._checked >= self.config.lifecycle.visibility_interval
        self._checked = self._number if check_visibility else self._checked
        rendered = result.render() if check_visibility else None
        retired = mapper.update_landmarks(view, rendered, tracked.inlier_ratios)
        view = view.without_landmarks(retired).with_pose(tracked.T_world_camera)
        mapper.update_unmatched(view)
        supported = status == "tracked" and mapper.has_enough_support(tracked.inlier_ratios)
        extended = self._extend_map(
            mapper, view, result.plane_points, result.unseen_ratios, status, supported
        )
        return replace(extended, retired=tuple(retired))

    def _extend_map(
        self,
        mapper: Mapper,
        view: LabelledFrame,
        plane_points: Float[np.ndarray, "n 3"],
        unseen_ratios: Mapping[int, float],
        status: Status,
        supported: bool,
    ) -> FrameResult:
        """Initialise landmarks; make the frame a keyframe if it contributes, and optimise jointly.

        Without enough support truncated objects are initialised, too; they inherit the pose's covariance.
        """
        assert self._motion is not None
        with self._timed("initialise"):
            new = mapper.initialise_landmarks(view, supported)
        view = replace(view, landmark_of={**view.landmark_of, **new})
        is_keyframe = bool(new) or self._contributes(mapper, view, unseen_ratios, status)
        if is_keyframe:
            view = self._after_joint(mapper, view)
            key = Keyframe.of(view, self._motion.pose_covariance)
            mapper.add_keyframe(key, plane_points, new.values())
            with self._timed("initialise"):
                key = mapper.refit_stale(key, unseen_ratios)
            if self.config.use_bundle_adjustment:
                with self._timed("joint"):
                    self._start_joint(mapper, key)
        self._previous = view
        return replace(
            self._result(self._motion, status), landmark_of=view.landmark_of, is_detected=True,
            new=tuple(new.values()), is_keyframe=is_keyframe,
        )  # fmt: skip

    def _contributes(
        self, mapper: Mapper, view: LabelledFrame, unseen_ratios: Mapping[int, float], status: Status
    ) -> bool:
        """Return whether a frame should become a keyframe for its viewpoint or for what it reveals."""
        landmarks = mapper.world.landmarks
        visible = {id: landmarks[id] for id in view.landmark_of.values() if id in landmarks}
        return (
            status == "tracked" and is_new_viewpoint(view.T_world_camera, visible, mapper.keyframes)
        ) or mapper.reveals_unseen_parts(view, unseen_ratios, status == "weak")

    def _start_joint(self, mapper: Mapper, key: Keyframe) -> None:
        """Start the joint optimisation of a new keyframe's window; apply that of the first frame at once."""
        config = self.config
        job = partial(optimise_jointly, mapper.window_of(key), self.decoder, config.bundle_adjustment)
        self._joint.start(job, self._number + config.joint_delay)
        if self._number == 0 or config.joint_delay == 0:
            self._take_joint(mapper)

    def _take_joint(self, mapper: Mapper) -> Float[np.ndarray, "4 4"]:
        """Wait for the joint optimisation, apply it to map and camera, and return its correction."""
        assert self._motion is not None
        correction = mapper.apply(self._joint.take())
        self._motion = self._motion.transformed(correction)
        return correction

    def _after_joint(self, mapper: Mapper, view: LabelledFrame) -> LabelledFrame:
        """Return a frame in the world of the joint optimisation in progress, which is applied."""
        if self._joint.due is None:
            return view
        with self._timed("joint"):
            return view.with_pose(self._take_joint(mapper) @ view.T_world_camera)

    def _recover(self, mapper: Mapper, frame: RgbdFrame, guess: CameraMotion) -> FrameResult:
        """Search for a lost camera near its prediction while that is accurate enough, or by relocalisation.

        The map does not change until the camera is found.
        """
        check = self.config.pose_check
        self._n_lost += 1
        if self._n_lost > 1 and guess.position_std < check.local_search_position_std:
            result = self._track_frame(mapper, frame, guess, _SEARCH_ITERATIONS)
            motion = check_pose(result.tracked, guess, check)[1]
            threshold = self.config.lifecycle.support_inlier_ratio
            n_agreeing = sum(ratio > threshold for ratio in result.tracked.inlier_ratios.values())
            if motion is not None:
                if motion.position_std < check.recovered_position_std and n_agreeing >= _SEARCH_MIN_LANDMARKS:
                    return self._resume(motion, result.view)
                self._motion = guess = motion
        found = self.relocalise(frame)
        if found is not None:
            covariance = np.linalg.inv(found.tracked.information + _MIN_INFORMATION * np.eye(6))
            motion = CameraMotion.with_unknown_velocity(
                frame.time, found.tracked.T_world_camera, self.config.motion, covariance, guess.period
            )
            if motion.position_std < check.recovered_position_std:
                return self._resume(motion, found.view)
        self._previous, mapper.unmatched = None, {}
        return replace(self._result(guess, "lost"), time=frame.time)

    def relocalise(self, frame: RgbdFrame) -> Relocalisation | None:
        """Find the pose of a frame by the map alone, without changing the map; None if that fails."""
        assert self.world is not None
        config = self.config
        with self._timed("detect"):
            detections = self._detect_unposed(frame)
        with self._timed("relocalise"):
            view = LabelledFrame.of(self._number, frame, detections)
            return relocalise(self.world, view, config.tracking, config.pixels, config.relocalisation)

    def _resume(self, motion: CameraMotion, view: LabelledFrame) -> FrameResult:
        """Continue tracking from a recovered pose."""
        logger.info("frame %d: recovered", self._number)
        self._n_lost, self._motion, self._previous = 0, motion, view
        return replace(
            self._result(motion, "tracked"), landmark_of=view.landmark_of, is_detected=bool(view.detections)
        )

    def _result(self, motion: CameraMotion, status: Status) -> FrameResult:
        seconds = dict(self._seconds)
        T, std = motion.T_world_camera, motion.position_std
        return FrameResult(self._number, motion.time, T, status, std, seconds=seconds)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        """Add the duration of a block to the stage's."""
        begin = self._now()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + self._now() - begin

    def _detect_unposed(self, frame: RgbdFrame) -> list[ObjectDetection]:
        """Return the detections of a frame of unknown pose, with the support plane fitted to the frame."""
        unposed = RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)
        try:
            plane = fit_support_plane([unposed])
            return merge_masks(unposed, self.detect(unposed, plane), plane, self.config.merging)
        except PerceptionError:
            return []
