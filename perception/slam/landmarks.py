"""The map: objects as landmarks, and their support plane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from perception.inference.problem import FitState
from perception.inference.shape_model import LinearisedShape
from perception.rendering.multi_object import ShapeStack
from perception.rendering.pose import object_by_camera
from perception.rendering.renderer import ShapeGrid
from perception.types import CATEGORIES, GRID_RESOLUTION, Category, ObjectDetection, SupportPlane

_DUPLICATE_DISTANCE = 0.35  # origin distance of duplicates, relative to the sum of the bounding radii
_OCCUPIED = 0.05  # occupancy probability from which a voxel counts towards the bounding radius
_PROBABILITY_MIN = 0.01  # floor of the class probabilities, so that no single view rules a class out


def fit_covariance(truncated: bool) -> Float[np.ndarray, "6 6"]:
    """Return the pose covariance of a single-view fit with a known camera pose (rotation, translation).

    Args:
        truncated: Whether the image border truncated the mask that the landmark was fitted to.
    """
    rotation, translation = (np.radians(3.0), 0.006) if truncated else (np.radians(1.5), 0.0025)
    return np.diag(np.repeat([rotation**2, translation**2], 3))


@dataclass(frozen=True)
class Landmark:
    """One object of the map.

    Attributes:
        id: Unique over the run; ids of retired landmarks are not reused.
        category: Class whose shape prior was fitted.
        state: Pose and shape code.
        shape: Linearisation of the decoder near the shape code.
        bounding_radius: Radius of a sphere about the object's origin that contains the object, in metres.
        sample_step: Distance between the renderer's samples, in voxels.
        log_votes: Sum of the log class probabilities over all views.
        score: Class confidence of the detection that was fitted.
        n_hits: Number of frames with a mask of the landmark.
        n_misses: Number of successive visibility checks without a mask where one was expected.
        n_outlier_frames: Number of successive frames in which most of its pixels disagreed with the map.
        n_see_through: Number of successive visibility checks that measured the background through it.
        truncated: Whether the image border truncated it in all views that it was fitted to.
        first_frame: Number of the frame in which it was initialised.
        n_updates: Number of times that its shape has been estimated.
        residual: Root mean square of the inlier depth residuals of the fit, in metres.
        covariance: Covariance of its pose (rotation in the object frame, translation in the world frame), in
            radians and metres.
    """

    id: int
    category: Category
    state: FitState
    shape: LinearisedShape
    bounding_radius: float
    sample_step: float
    log_votes: Float[np.ndarray, "c"]
    score: float = 1.0
    n_hits: int = 1
    n_misses: int = 0
    n_outlier_frames: int = 0
    n_see_through: int = 0
    truncated: bool = False
    first_frame: int = 0
    n_updates: int = 1
    residual: float = 0.0
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: fit_covariance(truncated=False))

    @cached_property
    def grid(self) -> ShapeGrid:
        """Occupancy grid of the shape code on the renderer's device."""
        return self.shape.at(self.state.code)

    @property
    def sample_distance(self) -> float:
        """Distance between the renderer's samples along a ray, in metres."""
        return self.sample_step * 2 * float(self.state.pose.scale.max()) / GRID_RESOLUTION

    def with_state(self, state: FitState) -> Landmark:
        """Return the landmark with another pose and shape code."""
        return replace(self, state=state, bounding_radius=bounding_radius(self.shape, state))

    def covariance_from(
        self, T_world_camera: Float[np.ndarray, "4 4"], camera_covariance: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "6 6"]:
        """Return the pose covariance of a fit in one view: that of the fit plus that of the camera.

        Args:
            T_world_camera: Pose of the camera.
            camera_covariance: Covariance of that pose (rotation, translation) in the camera frame.
        """
        by_camera = object_by_camera(self.state.pose, T_world_camera)
        return fit_covariance(self.truncated) + by_camera @ camera_covariance @ by_camera.T

    def with_detection(self, detection: ObjectDetection) -> Landmark:
        """Return the landmark after one more detection of it: class votes and hits."""
        log_votes = self.log_votes + log_probabilities(detection)
        return replace(self, log_votes=log_votes, n_hits=self.n_hits + 1, n_misses=0)

    @property
    def most_likely_category(self) -> Category:
        """Class with the largest sum of log probabilities."""
        return CATEGORIES[int(np.argmax(self.log_votes))]

    @property
    def class_log_odds(self) -> float:
        """Log probability by which the most likely class leads the fitted one, 0 if they agree."""
        return float(self.log_votes.max() - self.log_votes[CATEGORIES.index(self.category)])


@dataclass(frozen=True)
class LandmarkMap:
    """All landmarks by id, and their support plane, in the world frame."""

    plane: SupportPlane
    landmarks: Mapping[int, Landmark] = field(default_factory=dict)

    @cached_property
    def ids(self) -> tuple[int, ...]:
        """Ids of the landmarks in ascending order."""
        return tuple(sorted(self.landmarks))

    @cached_property
    def stack(self) -> ShapeStack:
        """Occupancy grids of all landmarks, in the order of ``ids``."""
        return ShapeStack.of([self.landmarks[id].grid for id in self.ids])

    def with_landmarks(self, *changed: Landmark) -> LandmarkMap:
        """Return the map with landmarks added or replaced; the stack is kept if no shape changed."""
        new = LandmarkMap(self.plane, {**self.landmarks, **{landmark.id: landmark for landmark in changed}})
        same_shapes = all(
            landmark.id in self.landmarks
            and landmark.shape is self.landmarks[landmark.id].shape
            and np.array_equal(landmark.state.code, self.landmarks[landmark.id].state.code)
            for landmark in changed
        )
        if same_shapes and "stack" in self.__dict__:
            new.__dict__["stack"] = self.stack
        return new

    def without(self, ids: set[int]) -> LandmarkMap:
        """Return the map without some landmarks."""
        kept = {id: landmark for id, landmark in self.landmarks.items() if id not in ids}
        return LandmarkMap(self.plane, kept)


def duplicates(landmarks: Mapping[int, Landmark]) -> set[int]:
    """Return the ids of landmarks that coincide with a landmark of more hits."""
    found: set[int] = set()
    order = sorted(landmarks.values(), key=lambda landmark: (-landmark.n_hits, landmark.id))
    for k, landmark in enumerate(order):
        if any(other.id not in found and coincide(landmark, other) for other in order[:k]):
            found.add(landmark.id)
    return found


def coincide(a: Landmark, b: Landmark) -> bool:
    """Return whether two landmarks are so close that they must be the same object."""
    return origin_distance(a, b) < _DUPLICATE_DISTANCE * (a.bounding_radius + b.bounding_radius)


def origin_distance(a: Landmark, b: Landmark) -> float:
    """Return the distance between the origins of two landmarks, in metres."""
    return float(np.linalg.norm(a.state.pose.translation - b.state.pose.translation))


def bounding_radius(shape: LinearisedShape, state: FitState) -> float:
    """Return the radius about the object's origin that contains its occupied voxels, in metres.

    The margin is one voxel. A shape without occupied voxels has the radius of its whole grid.
    """
    i = np.argwhere(shape.grid > _OCCUPIED)
    if not len(i):
        return float(np.linalg.norm(state.pose.scale))
    canonical = np.abs(-1 + (2 * i + 1) / GRID_RESOLUTION).max(axis=0)
    return float(np.linalg.norm((canonical + 2.5 / GRID_RESOLUTION) * state.pose.scale))


def log_probabilities(detection: ObjectDetection) -> Float[np.ndarray, "c"]:
    """Return the log class probabilities of a detection, bounded from below.

    A detection without class probabilities has its score for its class and equal shares for the others.
    """
    n = len(CATEGORIES)
    p = np.asarray(detection.class_probabilities, dtype=np.float64)[:n]
    if len(p) != n:
        p = np.full(n, (1 - detection.score) / (n - 1))
        p[CATEGORIES.index(detection.category)] = detection.score
    return np.log(np.clip(p, _PROBABILITY_MIN, 1.0))
