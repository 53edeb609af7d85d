"""The map: whole objects as landmarks, and the plane they stand on."""

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
from perception.types import CATEGORIES, GRID_RESOLUTION, Category, ObjectDetection, SupportPlane


def own_doubt(cut: bool) -> Float[np.ndarray, "6 6"]:
    """Of a landmark seen by a camera whose pose is known; more if only a part of it was in view."""
    turn, move = (np.radians(3.0), 0.006) if cut else (np.radians(1.5), 0.0025)
    return np.diag(np.repeat([turn**2, move**2], 3))


@dataclass(frozen=True)
class Landmark:
    """One object of the map.

    Attributes:
        id: unique over the run; numbers of retired objects are not used again.
        category: what it was fitted as.
        state: pose and shape code.
        shape: the decoder around a code near it.
        reach: radius of a sphere about its origin that holds it [m].
        step: between the renderer's samples, as a share of a voxel.
        log_votes: summed log probabilities of the classes over the views.
        score: class confidence of the fit.
        hits, misses: frames that showed it, and that should have but did not.
        bad: frames in a row in which most of its pixels disagreed with the map.
        through: looks in a row at which the camera saw through most of it.
        cut: it was cut by the image border when it was initialised.
        born: number of the frame in which it was initialised.
        updates: how often its shape was estimated.
        residual: root mean square of its inlier residuals in the last optimisation [m].
        doubt: covariance of where it stands (turn in its own frame, move in the world) [rad], [m].
    """

    id: int
    category: Category
    state: FitState
    shape: LinearisedShape
    reach: float
    step: float
    log_votes: Float[np.ndarray, "c"]
    score: float = 1.0
    hits: int = 1
    misses: int = 0
    bad: int = 0
    through: int = 0
    cut: bool = False
    born: int = 0
    updates: int = 1
    residual: float = 0.0
    doubt: Float[np.ndarray, "6 6"] = field(default_factory=lambda: own_doubt(False))

    @cached_property
    def grid(self):
        """The grid of its code, on the renderer's device."""
        return self.shape.at(self.state.code)

    @property
    def sample_distance(self) -> float:
        """Between the renderer's samples along a ray [m]."""
        return self.step * 2 * float(self.state.pose.scale.max()) / GRID_RESOLUTION

    def with_state(self, state: FitState, shape: LinearisedShape | None = None) -> Landmark:
        """The landmark elsewhere or of another shape."""
        shape = shape or self.shape
        return replace(self, state=state, shape=shape, reach=reach_of(shape, state))

    def seen_from(
        self, T_world_camera: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "6 6"]:
        """Its doubt if it stands where a camera of such doubt sees it."""
        by_camera = object_by_camera(self.state.pose, T_world_camera)
        return own_doubt(self.cut) + by_camera @ covariance @ by_camera.T

    def voted(self, detection: ObjectDetection) -> Landmark:
        """The landmark after one more view of it."""
        return replace(
            self, log_votes=self.log_votes + log_probabilities(detection), hits=self.hits + 1, misses=0
        )

    @property
    def likeliest(self) -> Category:
        """The class that most views speak for."""
        return CATEGORIES[int(np.argmax(self.log_votes))]


@dataclass(frozen=True)
class LandmarkMap:
    """All landmarks by id, and the plane they stand on, in the world frame."""

    plane: SupportPlane
    landmarks: Mapping[int, Landmark] = field(default_factory=dict)

    @cached_property
    def ids(self) -> tuple[int, ...]:
        return tuple(sorted(self.landmarks))

    @cached_property
    def stack(self) -> ShapeStack:
        """The grids of all landmarks, in the order of ``ids``."""
        return ShapeStack.of([self.landmarks[i].grid for i in self.ids])

    def with_landmarks(self, *changed: Landmark) -> LandmarkMap:
        """The map with landmarks added or replaced; grids are stacked anew only where one changed."""
        new = LandmarkMap(self.plane, {**self.landmarks, **{one.id: one for one in changed}})
        same = all(
            one.id in self.landmarks
            and one.shape is self.landmarks[one.id].shape
            and np.array_equal(one.state.code, self.landmarks[one.id].state.code)
            for one in changed
        )
        if same and "stack" in self.__dict__:
            new.__dict__["stack"] = self.stack
        return new

    def without(self, ids: set[int]) -> LandmarkMap:
        """The map without some landmarks."""
        return LandmarkMap(self.plane, {i: one for i, one in self.landmarks.items() if i not in ids})


def doubles(landmarks: Mapping[int, Landmark]) -> set[int]:
    """Landmarks that stand where one that was seen more often stands, too."""
    gone: set[int] = set()
    order = sorted(landmarks.values(), key=lambda one: (-one.hits, one.id))
    for k, one in enumerate(order):
        if any(other.id not in gone and stand_together(one, other) for other in order[:k]):
            gone.add(one.id)
    return gone


def stand_together(a: Landmark, b: Landmark) -> bool:
    """Whether two landmarks are so close that they must be one object."""
    return distance(a, b) < 0.35 * (a.reach + b.reach)


def distance(a: Landmark, b: Landmark) -> float:
    """Between their origins [m]."""
    return float(np.linalg.norm(a.state.pose.translation - b.state.pose.translation))


def reach_of(shape: LinearisedShape, state: FitState) -> float:
    """Radius about the object's origin that holds everything that is occupied, and a voxel more [m]."""
    i = np.argwhere(shape.grid > 0.05)
    if not len(i):
        return float(np.linalg.norm(state.pose.scale))
    canonical = np.abs(-1 + (2 * i + 1) / GRID_RESOLUTION).max(axis=0)
    return float(np.linalg.norm((canonical + 2.5 / GRID_RESOLUTION) * state.pose.scale))


def log_probabilities(detection: ObjectDetection) -> Float[np.ndarray, "c"]:
    """Of the classes, bounded from below, in the detection's own words or from its score."""
    n = len(CATEGORIES)
    p = np.asarray(detection.class_probabilities, dtype=np.float64)[:n]
    if len(p) != n:
        p = np.full(n, (1 - detection.score) / (n - 1))
        p[CATEGORIES.index(detection.category)] = detection.score
    return np.log(np.clip(p, 0.01, 1.0))
