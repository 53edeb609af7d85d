"""Mapping: the lifecycle of landmarks and keyframes, and their joint optimisation."""

from __future__ import annotations

import logging
import os
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.detection.geometry import touches_border
from perception.geometry import invert
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import hidden_by
from perception.inference.shape_model import Decoder
from perception.slam.association import RenderedMasks, see_through_ratios
from perception.slam.bundle_window import BundleResult, BundleWindow
from perception.slam.config import SlamConfig
from perception.slam.initialise import LandmarkViews, initialise_landmark, refitted
from perception.slam.keyframes import Keyframe, is_new_viewpoint, select_window
from perception.slam.labelled_frame import LabelledFrame
from perception.slam.landmarks import Landmark, LandmarkMap, coincide, duplicates, origin_distance
from perception.slam.lifecycle import has_failed, with_detections, with_visibility
from perception.slam.marginal_prior import MarginalPrior, ViewInformation
from perception.slam.pose_check import Status
from perception.slam.unmatched_masks import UnmatchedMask, updated_masks
from perception.types import ObjectDetection, SupportPlane

logger = logging.getLogger(__name__)

_REFIT_VIEWS = 3  # newest keyframes that a landmark is refitted to


class Mapper:
    """Map and keyframes.

    Attributes:
        world: The map; replaced whenever it changes.
        keyframes: Keyframes, oldest first.
        unmatched: Masks without a landmark in the newest frame, by label.
        next_id: Id of the next landmark.
    """

    def __init__(self, plane: SupportPlane, decoder: Decoder, config: SlamConfig) -> None:
        self.world = LandmarkMap(plane)
        self.decoder, self.config = decoder, config
        self.keyframes: list[Keyframe] = []
        self.unmatched: dict[int, UnmatchedMask] = {}
        self.next_id = 0
        self._plane_points: dict[int, Float[np.ndarray, "_n 3"]] = {}  # by keyframe number, camera frame
        self._information: dict[tuple[int, int], ViewInformation] = {}  # by keyframe number and landmark id

    def update_landmarks(
        self, view: LabelledFrame, rendered: RenderedMasks | None, inlier_ratios: Mapping[int, float]
    ) -> set[int]:
        """Update votes and counts of all landmarks, remove those that fail, and return their ids.

        Args:
            view: The newest frame with its association.
            rendered: Rendered masks if the frame is one of a visibility check.
            inlier_ratios: Inlier ratio of each landmark that tracking judged.
        """
        life, landmarks = self.config.lifecycle, self.world.landmarks
        if rendered is not None:
            checks = see_through_ratios(rendered, view.frame, self.config.association)
            landmarks = with_visibility(landmarks, rendered, checks, set(view.landmark_of.values()), life)
        updated = with_detections(landmarks, view, inlier_ratios, self.config.tracking.inlier_ratio_min)
        self.world = self.world.with_landmarks(*updated.values())
        retired = {id for id, landmark in updated.items() if has_failed(landmark, life)}
        retired |= duplicates(self.world.landmarks)
        if retired:
            logger.info("frame %d: retired landmarks %s", view.number, sorted(retired))
            self.world = self.world.without(retired)
        return retired

    def set_unmatched(self, view: LabelledFrame) -> None:
        """Make all masks of the first frame candidates for initialisation at once."""
        n_frames = self.config.lifecycle.min_frames_unmatched
        masks = (found.mask for found in view.detections)
        self.unmatched = {label: UnmatchedMask(mask, n_frames) for label, mask in enumerate(masks, start=1)}

    def update_unmatched(self, view: LabelledFrame) -> None:
        """Count for how many successive frames each mask without a landmark has been visible."""
        self.unmatched = updated_masks(self.unmatched, view)

    @property
    def needs_detections(self) -> bool:
        """Whether successive frames decide on a new mask, or on a landmark that may have been moved."""
        min_frames = self.config.lifecycle.min_frames_unmatched
        return any(mask.n_frames < min_frames for mask in self.unmatched.values()) or any(
            landmark.n_outlier_frames for landmark in self.world.landmarks.values()
        )

    @property
    def verifies_absence(self) -> bool:
        """Whether some landmark was missed or seen through at the last visibility check."""
        return any(x.n_misses or x.n_see_through for x in self.world.landmarks.values())

    def has_enough_support(self, inlier_ratios: Mapping[int, float]) -> bool:
        """Return whether enough landmarks agree with a frame, given their inlier ratios."""
        life = self.config.lifecycle
        n_agreeing = sum(ratio > life.support_inlier_ratio for ratio in inlier_ratios.values())
        return n_agreeing >= life.min_support

    def initialise_landmarks(self, view: LabelledFrame, supported: bool) -> dict[int, int]:
        """Initialise landmarks from masks that have been unmatched for long enough.

        Args:
            view: The newest frame with its tracked pose and association.
            supported: Whether enough landmarks constrain the camera; truncated masks then wait until the
                object is fully visible.

        Returns:
            Id of the new landmark of each label that has one.
        """
        due = [
            label
            for label, mask in self.unmatched.items()
            if label not in view.landmark_of
            and mask.is_due(view.detections[label - 1].mask, view.number, supported, self.config.lifecycle)
        ]
        for label in due:
            self.unmatched[label] = replace(self.unmatched[label], tried=view.number)
        with ThreadPoolExecutor(min(len(due), os.cpu_count() or 1) or 1) as pool:  # fits are independent
            fits = list(pool.map(lambda label: self._fit(view, view.detections[label - 1]), due))
        new = {}
        for label, fit in zip(due, fits):
            if fit is None or any(coincide(other, fit) for other in self.world.landmarks.values()):
                continue
            self.world = self.world.with_landmarks(replace(fit, id=self.next_id))
            new[label] = self.next_id
            self.next_id += 1
        return new

    def _fit(self, view: LabelledFrame, found: ObjectDetection) -> Landmark | None:
        """Fit a landmark to one mask; None if the fit fails."""
        others = [other.mask for other in view.detections if other is not found]
        ignore = hidden_by(view.frame, found.mask, others)
        observation = ObjectObservation(view.frame, found.mask, ignore, found.yaw_probabilities)
        views = LandmarkViews(self.next_id, [observation], found, view.number)
        return initialise_landmark(views, self.decoder, self.world.plane, self.config.fit)

    def contributes(self, view: LabelledFrame, unseen_ratios: Mapping[int, float], status: Status) -> bool:
        """Return whether a frame should become a keyframe for its viewpoint or for what it reveals."""
        landmarks = self.world.landmarks
        visible = {id: landmarks[id] for id in view.landmark_of.values() if id in landmarks}
        return (
            status == "tracked" and is_new_viewpoint(view.T_world_camera, visible, self.keyframes)
        ) or self.reveals_unseen_parts(view, unseen_ratios, status == "weak")

    def reveals_unseen_parts(
        self, view: LabelledFrame, unseen_ratios: Mapping[int, float], weak: bool
    ) -> bool:
        """Return whether a frame should become a keyframe for what it reveals of known objects.

        It should if it shows much of an object that no keyframe had in view, an object that was moved, or all
        of an object that was truncated in all keyframes; at intervals, which are shorter while the pose is
        weak.

        Args:
            view: The newest frame with its association.
            unseen_ratios: Share of each landmark's pixels that no keyframe had in view.
            weak: Whether the pose is weak.
        """
        landmarks, life = self.world.landmarks, self.config.lifecycle
        interval = life.retry_interval_weak if weak else life.retry_interval
        if not self.keyframes or view.number - self.keyframes[-1].number < interval:
            return False
        visible = {label: landmarks[id] for label, id in view.landmark_of.items() if id in landmarks}
        threshold = life.refit_after_outlier_frames
        moved = any(landmark.n_outlier_frames >= threshold for landmark in visible.values())
        if moved or max(unseen_ratios.values(), default=0.0) > life.unseen_ratio:
            return True
        truncated = [label for label, landmark in visible.items() if landmark.truncated]
        return any(not touches_border(view.labels == label) for label in truncated)

    def add_keyframe(
        self, key: Keyframe, plane_points: Float[np.ndarray, "n 3"], new: Collection[int]
    ) -> None:
        """Add a keyframe and drop the oldest beyond the limit.

        The covariance of new landmarks, and of those that this view determines better, becomes that of a fit
        in this view.

        Args:
            key: The keyframe.
            plane_points: Measured points of the plane in its camera frame, in metres.
            new: Ids of the landmarks that were initialised in it.
        """
        for id in key.landmark_ids & set(self.world.landmarks):
            landmark = self.world.landmarks[id]
            covariance = landmark.covariance_from(key.T_world_camera, key.covariance)
            if id in new or np.trace(covariance[3:, 3:]) < np.trace(landmark.covariance[3:, 3:]):
                self.world = self.world.with_landmarks(replace(landmark, covariance=covariance))
        self.keyframes = [*self.keyframes, key][-self.config.lifecycle.max_keyframes :]
        points = {**self._plane_points, key.number: plane_points}
        self._plane_points = {k.number: points[k.number] for k in self.keyframes}
        self._information = {
            (number, id): information
            for (number, id), information in self._information.items()
            if number in self._plane_points and id in self.world.landmarks
        }

    def refit_stale(self, key: Keyframe, unseen_ratios: Mapping[int, float]) -> Keyframe:
        """Refit at most one stale landmark of the newest keyframe.

        A landmark is stale if the votes favour another class, if it was truncated and is now fully visible or
        shows much that was unseen, or if its pixels have disagreed for several frames, as it was moved.

        Args:
            key: The newest keyframe.
            unseen_ratios: Share of each landmark's pixels that no keyframe had in view.

        Returns:
            The keyframe without observations of landmarks that still disagree.
        """
        life = self.config.lifecycle
        observed = key.landmark_ids & set(self.world.landmarks)
        for id in sorted(observed, key=lambda id: (-unseen_ratios.get(id, 0.0), id)):
            landmark = self.world.landmarks[id]
            revealed = landmark.truncated and (
                not touches_border(key.mask(id)) or unseen_ratios.get(id, 0.0) > life.unseen_ratio
            )
            stale = (
                landmark.class_log_odds > life.class_log_odds
                or revealed
                or landmark.n_outlier_frames >= life.refit_after_outlier_frames
            )
            if stale and self._refit(key, landmark):
                break  # bounds the time spent on one frame
        landmarks = self.world.landmarks
        outliers = {id for id in observed if landmarks[id].n_outlier_frames and not landmarks[id].truncated}
        key = next(k for k in self.keyframes if k.number == key.number).without_landmarks(outliers)
        self.keyframes = [key if k.number == key.number else k for k in self.keyframes]
        return key

    def _refit(self, key: Keyframe, landmark: Landmark) -> bool:
        """Refit a landmark to its last views, or to the newest alone if it was moved; return success."""
        id, life = landmark.id, self.config.lifecycle

        def fit_to(keys: Sequence[Keyframe]) -> Landmark | None:
            found = ObjectDetection(landmark.most_likely_category, landmark.score, key.mask(id))
            observations = [k.observation(id) for k in keys]
            views = LandmarkViews(id, observations, found, landmark.first_frame)
            return initialise_landmark(views, self.decoder, self.world.plane, self.config.fit)

        fit = fit_to([key]) if landmark.n_outlier_frames >= life.refit_after_outlier_frames else None
        if fit is not None and origin_distance(fit, landmark) > life.moved_distance:
            logger.info("frame %d: landmark %d was moved", key.number, id)
            self.keyframes = [
                k if k.number == key.number else k.without_landmarks({id}) for k in self.keyframes
            ]
        else:
            fit = fit_to([k for k in self.keyframes if id in k.landmark_ids][-_REFIT_VIEWS:])
        if fit is None:
            return False
        logger.info("frame %d: landmark %d refitted as %s", key.number, id, fit.category)
        new = refitted(landmark, fit)
        covariance = new.covariance_from(key.T_world_camera, key.covariance)
        self.world = self.world.with_landmarks(replace(new, covariance=covariance))
        self._information = {at: view for at, view in self._information.items() if at[1] != id}
        return True

    def window_of(self, key: Keyframe) -> BundleWindow:
        """Return the problem of joint optimisation of the newest keyframe and its neighbours."""
        config = self.config.bundle_adjustment
        keyframes = select_window(key, self.keyframes, self.world.landmarks, config.window_size)
        return BundleWindow(
            keyframes=keyframes,
            landmarks=self.world.landmarks,
            plane=self.world.plane,
            plane_points=[self._plane_points[k.number] for k in keyframes],
            priors=self._marginal_priors({k.number for k in keyframes}),
        )

    def apply(self, result: BundleResult) -> Float[np.ndarray, "4 4"]:
        """Apply a joint optimisation; return the correction of its newest keyframe in the world frame.

        Landmarks and keyframes that were removed since the window was taken stay removed; counts and votes of
        the others are kept.
        """
        landmarks = self.world.landmarks
        self._information |= {at: view for at, view in result.information.items() if at[1] in landmarks}
        optimised = {id: new for id, new in result.landmarks.items() if id in landmarks}
        self.world = self.world.with_landmarks(
            *(
                replace(landmarks[id], shape=new.shape, n_updates=new.n_updates).with_state(new.state)
                for id, new in optimised.items()
            )
        )
        newest = result.keyframes[-1]
        before = next(k for k in self.keyframes if k.number == newest.number)
        poses = {k.number: k.T_world_camera for k in result.keyframes}
        self.keyframes = [k.with_pose(poses[k.number]) if k.number in poses else k for k in self.keyframes]
        return newest.T_world_camera @ invert(before.T_world_camera)

    def _marginal_priors(self, window: set[int]) -> dict[int, MarginalPrior]:
        """Return the prior on each landmark from the keyframes outside a window of keyframe numbers."""
        views: dict[int, list[ViewInformation]] = {}
        for (number, id), view in self._information.items():
            if number not in window and id in self.world.landmarks:
                views.setdefault(id, []).append(view)
        limit = self.config.bundle_adjustment.max_prior_views
        return {id: MarginalPrior.of(v, self.world.landmarks[id].state, limit) for id, v in views.items()}
