"""Frames that are kept to optimise with: new objects, and new viewpoints on old ones.

The viewpoint of a frame on an object is the direction from the object to the camera. A frame becomes a
keyframe if an object was initialised in it, or if it sees an object from more than 13 degrees away from every
keyframe that saw it. (The paper measures from the frame of initialisation; then nearly every frame is one.)
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import hidden_by
from perception.slam.landmarks import Landmark
from perception.types import ObjectDetection, RgbdFrame

NEW_VIEW = np.radians(13.0)


@dataclass(frozen=True)
class Keyframe:
    """A frame with its pose and what it shows of which landmark.

    Attributes:
        number: of the frame in the sequence.
        frame: images and camera pose.
        labels: the masks; label k + 1 is detection k.
        landmark_of: label to landmark id.
        yaw_of: landmark id to the yaw probabilities of its detection here.
        covariance: of the camera's pose when it was taken (rotation, translation, in its frame).
    """

    number: int
    frame: RgbdFrame
    labels: UInt8[np.ndarray, "h w"]
    landmark_of: Mapping[int, int]
    yaw_of: Mapping[int, Float[np.ndarray, "b"]]
    covariance: Float[np.ndarray, "6 6"] = field(default_factory=lambda: np.eye(6))

    @property
    def T_world_camera(self) -> Float[np.ndarray, "4 4"]:
        assert self.frame.T_world_camera is not None
        return self.frame.T_world_camera

    @property
    def landmarks(self) -> set[int]:
        return set(self.landmark_of.values())

    def has_in_view(self, points: Float[np.ndarray, "n 3"], margin: float = 2.0) -> Bool[np.ndarray, "n"]:
        """Which points of the world lie in its image, ``margin`` pixels or more from the border."""
        camera, seen = self.frame.intrinsics, transform_points(invert(self.T_world_camera), points)
        z = np.maximum(seen[:, 2], 1e-6)
        u, v = camera.fx * seen[:, 0] / z + camera.cx, camera.fy * seen[:, 1] / z + camera.cy
        return (
            (seen[:, 2] > 0)
            & (np.abs(u - (camera.width - 1) / 2) <= (camera.width - 1) / 2 - margin)
            & (np.abs(v - (camera.height - 1) / 2) <= (camera.height - 1) / 2 - margin)
        )

    def moved(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Keyframe:
        """The keyframe with another pose."""
        return replace(self, frame=with_pose(self.frame, T_world_camera))

    def without(self, landmarks: Collection[int]) -> Keyframe:
        """The keyframe as if it did not know what shows these landmarks."""
        return replace(
            self, landmark_of={k: one for k, one in self.landmark_of.items() if one not in landmarks}
        )

    def mask(self, landmark: int) -> Bool[np.ndarray, "h w"]:
        """The pixels that show a landmark."""
        return self.labels == next(k for k, one in self.landmark_of.items() if one == landmark)

    def observation(self, landmark: int) -> ObjectObservation:
        """What it shows of a landmark; what other masks may hide is marked."""
        mask = self.mask(landmark)
        others = (self.labels != 0) & ~mask
        ignore = hidden_by(self.frame, mask, [others]) if others.any() else None
        return ObjectObservation(self.frame, mask, ignore, self.yaw_of.get(landmark, np.zeros(0)))


def make_keyframe(
    number: int,
    frame: RgbdFrame,
    T_world_camera: Float[np.ndarray, "4 4"],
    labels: UInt8[np.ndarray, "h w"],
    landmark_of: Mapping[int, int],
    detections: Sequence[ObjectDetection],
    covariance: Float[np.ndarray, "6 6"],
) -> Keyframe:
    """Keeps a frame."""
    yaws = {
        one: detections[label - 1].yaw_probabilities
        for label, one in landmark_of.items()
        if detections[label - 1].yaw_probabilities.size
    }
    return Keyframe(number, with_pose(frame, T_world_camera), labels, dict(landmark_of), yaws, covariance)


def with_pose(frame: RgbdFrame, T_world_camera: Float[np.ndarray, "4 4"]) -> RgbdFrame:
    """The frame as seen from a pose."""
    return RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics, T_world_camera)


def view_angle(
    centre: Float[np.ndarray, "3"], T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"]
) -> float:
    """Angle at a point between the directions to two cameras [rad]."""
    a, b = T_a[:3, 3] - centre, T_b[:3, 3] - centre
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.arccos(np.clip(cosine, -1, 1)))


def shows_new_view(
    T_world_camera: Float[np.ndarray, "4 4"],
    seen: Mapping[int, Landmark],
    keyframes: Sequence[Keyframe],
    least: float = NEW_VIEW,
) -> bool:
    """Whether some landmark is seen from ``least`` [rad] or more away from every keyframe that saw it."""
    for one, landmark in seen.items():
        centre = landmark.state.pose.translation
        angles = [
            view_angle(centre, T_world_camera, k.T_world_camera) for k in keyframes if one in k.landmarks
        ]
        if not angles or min(angles) > least:
            return True
    return False


def window_of(
    newest: Keyframe, keyframes: Sequence[Keyframe], landmarks: Mapping[int, Landmark], size: int = 3
) -> list[Keyframe]:
    """The keyframe and those nearest to it, by the mean viewing angle on what both see; oldest first."""

    def distance(other: Keyframe) -> float:
        common = [one for one in newest.landmarks & other.landmarks if one in landmarks]
        if not common:
            return np.inf
        centres = [landmarks[one].state.pose.translation for one in common]
        angles = [view_angle(c, newest.T_world_camera, other.T_world_camera) for c in centres]
        return float(np.mean(angles)) / len(common) ** 0.5

    others = [k for k in keyframes if k is not newest and np.isfinite(distance(k))]
    nearest = sorted(others, key=distance)[: size - 1]
    return sorted([*nearest, newest], key=lambda k: k.number)
