"""The map's keeper: landmarks come, are voted on, mended and retired; keyframes are kept and optimised."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.geometry import invert
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import hidden_by
from perception.inference.shape_model import Decoder
from perception.slam.association import RenderedMasks, seen_through
from perception.slam.bundle_adjustment import optimise_jointly
from perception.slam.config import SlamConfig
from perception.slam.initialise import initialise_landmark, is_cut, renewed, touches_border
from perception.slam.keyframes import Keyframe, window_of
from perception.slam.landmarks import Landmark, LandmarkMap, distance, doubles, stand_together
from perception.slam.marginal_prior import Memory, View
from perception.slam.tracking import TrackedPose
from perception.types import CATEGORIES, ObjectDetection, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)


class Mapper:
    """Map and keyframes.

    Attributes:
        world: the map; a new value whenever it changes.
        keyframes: oldest first.
        unmatched: masks of no landmark in the last frame, and for how many frames they have been there.
        next_id: for the next landmark.
    """

    def __init__(self, plane: SupportPlane, decoder: Decoder, config: SlamConfig) -> None:
        self.world = LandmarkMap(plane)
        self.decoder, self.config = decoder, config
        self.keyframes: list[Keyframe] = []
        self.unmatched: list[tuple[np.ndarray, int]] = []
        self.next_id = 0
        self._plane_points: dict[int, np.ndarray] = {}  # of each keyframe
        self._views: dict[tuple[int, int], View] = {}  # what keyframes said of landmarks

    def count(
        self,
        frame: RgbdFrame,
        detections: Sequence[ObjectDetection],
        landmark_of: Mapping[int, int],
        rendered: RenderedMasks | None,
        tracked: TrackedPose,
        number: int,
    ) -> set[int]:
        """Votes, hits and misses of the landmarks; those that are to go are taken out and returned."""
        life, changed = self.config.life, []
        through = seen_through(rendered, frame, self.config.association) if rendered else {}
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
            if one in through:
                gone = through[one] > life.through_share
                landmark = replace(landmark, through=landmark.through + 1 if gone else 0)
            changed.append(landmark)
        self.world = self.world.with_landmarks(*changed)
        retired = {
            x.id
            for x in changed
            if x.misses > min(life.max_misses, x.hits) or x.bad > life.max_bad or x.through > life.max_through
        } | doubles(self.world.landmarks)
        if retired:
            logger.info("frame %d: retired %s", number, sorted(retired))
            self.world = self.world.without(retired)
        return retired

    def remember_unmatched(
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
                for mask, count in self.unmatched
                if (mask & found.mask).sum() > 0.2 * (mask | found.mask).sum()
            ]
            now.append((found.mask, 1 + max(before, default=0)))
        self.unmatched = now

    def holds(self, shares: Mapping[int, float]) -> bool:
        """Whether the landmarks that agree with a frame, by these shares of their pixels, are enough."""
        life = self.config.life
        return sum(share > life.enough_share for share in shares.values()) >= life.enough

    def new_landmarks(
        self,
        posed: RgbdFrame,
        detections: Sequence[ObjectDetection],
        landmark_of: Mapping[int, int],
        held: bool,
        number: int,
    ) -> dict[int, int]:
        """Landmarks from masks that have had none for a while; cut ones wait while the pose is held."""
        life, new = self.config.life, {}
        ages = {id(mask): age for mask, age in self.unmatched}
        for label, found in enumerate(detections, start=1):
            age = ages.get(id(found.mask), 0)
            waits = age < life.seen_before or (age - life.seen_before) % life.retry
            cut = touches_border(found)
            small = np.count_nonzero(found.mask) < (life.min_pixels_cut if cut else life.min_pixels)
            if label in landmark_of or waits or small or (cut and held):
                continue
            landmark = self._initialise(posed, detections, found, number)
            if landmark is not None:
                self.world = self.world.with_landmarks(landmark)
                new[label] = landmark.id
                self.next_id += 1
        return new

    def _initialise(
        self, posed: RgbdFrame, detections: Sequence[ObjectDetection], found: ObjectDetection, number: int
    ) -> Landmark | None:
        others = [other.mask for other in detections if other is not found]
        ignore = hidden_by(posed, found.mask, others)
        seen = ObjectObservation(posed, found.mask, ignore, found.yaw_probabilities)
        landmark = initialise_landmark(
            [seen], found, self.decoder, self.world.plane, self.config.fit, self.next_id, number
        )
        if landmark is None or self._overlaps(landmark):
            return None
        return landmark

    def _overlaps(self, landmark: Landmark) -> bool:
        """Whether another landmark stands where this one would."""
        return any(stand_together(one, landmark) for one in self.world.landmarks.values())

    def completes(
        self,
        detections: Sequence[ObjectDetection],
        landmark_of: Mapping[int, int],
        unknown: Mapping[int, float],
        weak: bool,
        number: int,
    ) -> bool:
        """Whether a frame shows much of an object of which the map saw a part alone, or one that was moved.

        Not too often, as each such frame is kept; sooner where the pose is weak, which needs what is new.

        Args:
            detections, landmark_of: of the frame.
            unknown: of each landmark the share of its pixels that no keyframe had in view.
            weak: whether the pose is.
            number: of the frame.
        """
        landmarks, life = self.world.landmarks, self.config.life
        wait = life.retry_weak if weak else life.retry
        if not self.keyframes or number - self.keyframes[-1].number < wait:
            return False
        moved = any(
            landmarks[one].bad >= life.moved_after for one in landmark_of.values() if one in landmarks
        )
        if moved or max(unknown.values(), default=0.0) > life.new_part:
            return True
        cut = [label for label, one in landmark_of.items() if one in landmarks and landmarks[one].cut]
        return any(not touches_border(detections[label - 1]) for label in cut)

    def keep(self, key: Keyframe, plane_points: Float[np.ndarray, "n 3"], new: Collection[int]) -> None:
        """One more keyframe, with the plane's points in its camera's frame; the oldest make room.

        What it shows stands as surely as its camera does: new landmarks, and those known less well before.
        """
        for one in key.landmarks & set(self.world.landmarks):
            landmark = self.world.landmarks[one]
            doubt = landmark.seen_from(key.T_world_camera, key.covariance)
            if one in new or np.trace(doubt[3:, 3:]) < np.trace(landmark.doubt[3:, 3:]):
                self.world = self.world.with_landmarks(replace(landmark, doubt=doubt))
        self.keyframes = [*self.keyframes, key][-self.config.life.max_keyframes :]
        points = {**self._plane_points, key.number: plane_points}
        self._plane_points = {k.number: points[k.number] for k in self.keyframes}
        self._views = {
            (number, one): view
            for (number, one), view in self._views.items()
            if number in self._plane_points and one in self.world.landmarks
        }

    def mend(self, key: Keyframe, unknown: Mapping[int, float]) -> Keyframe:
        """Fits one landmark of the newest keyframe anew, if it needs that; returns what to optimise with.

        It needs that if the views have voted its class down; if it started from a mask that the image border
        cut and now the whole object, or much of what was ``unknown`` (see ``completes``), is in view; or if
        its pixels have disagreed for a while, as it was moved. Landmarks that still disagree are left out.
        """
        life = self.config.life
        known = key.landmarks & set(self.world.landmarks)
        for one in sorted(known, key=lambda one: (-unknown.get(one, 0.0), one)):
            landmark = self.world.landmarks[one]
            lead = landmark.log_votes.max() - landmark.log_votes[CATEGORIES.index(landmark.category)]
            more = landmark.cut and (not is_cut(key.mask(one)) or unknown.get(one, 0.0) > life.new_part)
            needs = lead > life.class_margin or more or landmark.bad >= life.moved_after
            if needs and self._fit_anew(key, landmark):
                break  # one is enough for a frame
        aside = {one for one in known if (now := self.world.landmarks[one]).bad and not now.cut}
        key = next(k for k in self.keyframes if k.number == key.number).without(aside)
        self.keyframes = [key if k.number == key.number else k for k in self.keyframes]
        return key

    def _fit_anew(self, key: Keyframe, landmark: Landmark) -> bool:
        """Another start for a landmark: by its last views, or by the newest alone if it was moved."""
        one, life = landmark.id, self.config.life

        def fitted(views: Sequence[Keyframe]) -> Landmark | None:
            found = ObjectDetection(landmark.likeliest, landmark.score, key.mask(one))
            seen = [k.observation(one) for k in views]
            plane, fit = self.world.plane, self.config.fit
            return initialise_landmark(seen, found, self.decoder, plane, fit, one, landmark.born)

        other = fitted([key]) if landmark.bad >= life.moved_after else None
        if other is not None and distance(other, landmark) > life.moved_by:
            logger.info("frame %d: landmark %d was moved", key.number, one)
            self.keyframes = [k if k.number == key.number else k.without({one}) for k in self.keyframes]
        else:
            other = fitted([k for k in self.keyframes if one in k.landmarks][-3:])
        if other is None:
            return False
        logger.info("frame %d: landmark %d fitted anew as %s", key.number, one, other.category)
        new = renewed(landmark, other)
        doubt = new.seen_from(key.T_world_camera, key.covariance)
        self.world = self.world.with_landmarks(replace(new, doubt=doubt))
        self._views = {key: view for key, view in self._views.items() if key[1] != one}
        return True

    def optimise(self, key: Keyframe) -> Float[np.ndarray, "4 4"]:
        """The newest keyframe with its nearest ones, jointly; returns how it moved, in the world."""
        window = window_of(key, self.keyframes, self.world.landmarks, self.config.joint.window)
        result = optimise_jointly(
            window, self.world.landmarks, self.decoder, self.world.plane,
            [self._plane_points[k.number] for k in window], self.config.joint,
            self._known_outside({k.number for k in window}),
        )  # fmt: skip
        self._views |= result.views
        self.world = self.world.with_landmarks(*result.landmarks.values())
        moved = {k.number: k for k in result.keyframes}
        self.keyframes = [moved.get(k.number, k) for k in self.keyframes]
        return moved[key.number].T_world_camera @ invert(key.T_world_camera)

    def _known_outside(self, window: set[int]) -> dict[int, Memory]:
        """What keyframes outside a window have said of each landmark."""
        by_landmark: dict[int, list[View]] = {}
        for (number, one), view in self._views.items():
            if number not in window and one in self.world.landmarks:
                by_landmark.setdefault(one, []).append(view)
        return {
            one: Memory.of(views, self.world.landmarks[one].state, self.config.joint.memory)
            for one, views in by_landmark.items()
        }
