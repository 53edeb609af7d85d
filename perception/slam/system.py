"""Object-level SLAM, frame by frame. ``Slam.process`` is the place to start reading.

    frame + masks -> data association -> camera pose -> new landmarks, keyframe -> joint optimisation

Masks come from the detector on keyframes and where the map does not explain what the frame shows
(``detection_schedule``); between, they are rendered from the map (``mask_tracking``). Joint optimisation runs
beside tracking and is applied a fixed number of frames later; while the pose is weak, at once, as the next
frames depend on it.

NodeSLAM, section "Object-Level SLAM System".
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Float

from perception.inference.shape_model import Decoder
from perception.pipeline import Device, load_perception
from perception.slam.association import associate_masks, render_masks
from perception.slam.config import SlamConfig
from perception.slam.detection_schedule import DetectionSchedule
from perception.slam.estimates import object_estimates
from perception.slam.frame_detections import Detect, detect_posed, detect_unposed
from perception.slam.frame_result import FrameResult
from perception.slam.frame_tracking import TrackedFrame, track_view
from perception.slam.joint_optimisation import JointOptimisation
from perception.slam.keyframes import Keyframe
from perception.slam.labelled_frame import LabelledFrame, with_pose
from perception.slam.landmarks import LandmarkMap
from perception.slam.mapping import Mapper
from perception.slam.mask_tracking import track_masks
from perception.slam.motion import CameraMotion
from perception.slam.pixels import select_pixels
from perception.slam.pose_check import Status, check_pose
from perception.slam.recovery import SEARCH_ITERATIONS, is_certain, relocalised_motion, searched_motion
from perception.slam.relocalise import Relocalisation, relocalise
from perception.slam.stage_timer import Clock, StageTimer
from perception.support_plane import fit_support_plane
from perception.threads import single_threaded
from perception.types import ObjectEstimate, RgbdFrame

logger = logging.getLogger(__name__)


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
        self.decoder, self.detect, self.config = decoder, detect, config or SlamConfig()
        self.mapper: Mapper | None = None
        self._number = -1
        self._motion: CameraMotion | None = None  # after the last frame whose pose was accepted
        self._n_lost = 0  # successive lost frames
        self._previous: LabelledFrame | None = None
        self._timer = StageTimer(clock)
        self._schedule = DetectionSchedule(self.config.detection)
        self._checked = 0  # number of the last frame with a visibility check
        self._joint = JointOptimisation(decoder, self.config)

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
        if self._joint.in_progress and self.mapper is not None:
            with self._timer.stage("joint"):
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
        with single_threaded():  # objects are fitted in parallel, one thread each
            return self._process(frame)

    def _process(self, frame: RgbdFrame) -> FrameResult:
        self._number += 1
        self._timer.reset()
        if self.mapper is None:
            return self._initialise_map(frame)
        if self._joint.is_due(self._number):
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
        with self._timer.stage("detect"):
            detections = detect_posed(self.detect, posed, plane, self.config.merging)
        view = LabelledFrame.of(self._number, posed, detections)
        mapper.set_unmatched(view)
        pixels = select_pixels(view, plane, self.config.pixels)
        return self._extend_map(mapper, view, pixels.plane_points, {}, "tracked", False)

    def _follow(self, mapper: Mapper, frame: RgbdFrame, predicted: CameraMotion) -> FrameResult | None:
        """Track with masks rendered from the map, which stays as it is; None if detections are needed."""
        config, T_predicted = self.config, predicted.T_world_camera
        with self._timer.stage("track"):
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
            if self._schedule.allows_keyframe(self._number) and mapper.contributes(
                view, result.unseen_ratios, status
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
        with self._timer.stage("detect"):
            detections = detect_posed(self.detect, posed, world.plane, config.merging)
        with self._timer.stage("track"):
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
        with self._timer.stage("initialise"):
            new = mapper.initialise_landmarks(view, supported)
        view = replace(view, landmark_of={**view.landmark_of, **new})
        is_keyframe = bool(new) or mapper.contributes(view, unseen_ratios, status)
        if is_keyframe:
            view = self._after_joint(mapper, view)
            key = Keyframe.of(view, self._motion.pose_covariance)
            mapper.add_keyframe(key, plane_points, new.values())
            with self._timer.stage("initialise"):
                key = mapper.refit_stale(key, unseen_ratios)
            if self.config.use_bundle_adjustment:
                with self._timer.stage("joint"):
                    self._joint.start(mapper, key, at_once=self._number == 0 or status == "weak")
                    if self._joint.is_due(self._number):
                        self._take_joint(mapper)
        self._previous = view
        return replace(
            self._result(self._motion, status), landmark_of=view.landmark_of, is_detected=True,
            new=tuple(new.values()), is_keyframe=is_keyframe,
        )  # fmt: skip

    def _take_joint(self, mapper: Mapper) -> Float[np.ndarray, "4 4"]:
        """Wait for the joint optimisation, apply it to map and camera, and return its correction."""
        assert self._motion is not None
        correction = self._joint.apply(mapper)
        self._motion = self._motion.transformed(correction)
        return correction

    def _after_joint(self, mapper: Mapper, view: LabelledFrame) -> LabelledFrame:
        """Return a frame in the world of the joint optimisation in progress, which is applied."""
        if not self._joint.in_progress:
            return view
        with self._timer.stage("joint"):
            return view.with_pose(self._take_joint(mapper) @ view.T_world_camera)

    def _recover(self, mapper: Mapper, frame: RgbdFrame, guess: CameraMotion) -> FrameResult:
        """Search for a lost camera near its prediction while that is accurate enough, or by relocalisation.

        The map does not change until the camera is found.
        """
        config = self.config
        self._n_lost += 1
        if self._n_lost > 1 and guess.position_std < config.pose_check.local_search_position_std:
            result = self._track_frame(mapper, frame, guess, SEARCH_ITERATIONS)
            motion, found = searched_motion(result.tracked, guess, config)
            if found:
                return self._resume(motion, result.view)
            if motion is not guess:
                self._motion = guess = motion
        relocalised = self.relocalise(frame)
        if relocalised is not None:
            motion = relocalised_motion(relocalised.tracked, frame.time, guess.period, config)
            if is_certain(motion, config):
                return self._resume(motion, relocalised.view)
        self._previous, mapper.unmatched = None, {}
        return replace(self._result(guess, "lost"), time=frame.time)

    def relocalise(self, frame: RgbdFrame) -> Relocalisation | None:
        """Find the pose of a frame by the map alone, without changing the map; None if that fails."""
        assert self.world is not None
        config = self.config
        with self._timer.stage("detect"):
            detections = detect_unposed(self.detect, frame, config.merging)
        with self._timer.stage("relocalise"):
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
        T, std = motion.T_world_camera, motion.position_std
        return FrameResult(self._number, motion.time, T, status, std, seconds=self._timer.seconds)
