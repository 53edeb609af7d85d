"""Keyframes: the frames that joint optimisation uses.

The viewpoint of a frame on an object is the direction from the object to the camera. A frame becomes a
keyframe if an object was initialised in it, or if its viewpoint on an object differs by more than 13 degrees
from that of every keyframe of the object. (The paper compares with the frame of initialisation alone, which
makes nearly every frame of an orbit a keyframe.)
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from perception.geometry import invert, transform_points
from perception.inference.observation import ObjectObservation
from perception.inference.reconstruct import hidden_by
from perception.slam.labelled_frame import BACKGROUND, LabelImage, LabelledFrame, with_pose
from perception.slam.landmarks import Landmark
from perception.types import RgbdFrame

MIN_VIEW_ANGLE = np.radians(13.0)


@dataclass(frozen=True)
class Keyframe:
    """A frame that is kept, without the masks of its detections.

    Attributes:
        number: Index of the frame in the sequence.
        frame: Images and camera pose.
        labels: Label image of the masks.
        landmark_of: Landmark id of each associated label.
        yaw_probabilities: Yaw probabilities of the detection of each landmark id, where there are any.
        covariance: Covariance of the camera pose when the frame was taken (rotation, translation, camera
            frame), in radians and metres.
    """

    number: int
    frame: RgbdFrame
    labels: LabelImage
    landmark_of: Mapping[int, int]
    yaw_probabilities: Mapping[int, Float[np.ndarray, "b"]]
    covariance: Float[np.ndarray, "6 6"]

    @staticmethod
    def of(view: LabelledFrame, covariance: Float[np.ndarray, "6 6"]) -> Keyframe:
        """Return a keyframe of a posed and associated frame."""
        found = {id: view.detections[label - 1] for label, id in view.landmark_of.items()}
        yaws = {id: d.yaw_probabilities for id, d in found.items() if d.yaw_probabilities.size}
        return Keyframe(view.number, view.frame, view.labels, dict(view.landmark_of), yaws, covariance)

    @property
    def T_world_camera(self) -> Float[np.ndarray, "4 4"]:
        assert self.frame.T_world_camera is not None
        return self.frame.T_world_camera

    @property
    def landmark_ids(self) -> set[int]:
        """Ids of the landmarks that it observes."""
        return set(self.landmark_of.values())

    def has_in_view(self, points: Float[np.ndarray, "n 3"], margin: float = 2.0) -> Bool[np.ndarray, "n"]:
        """Return which world points project into the image, at least ``margin`` pixels from its border."""
        camera = self.frame.intrinsics
        in_camera = transform_points(invert(self.T_world_camera), points)
        z = np.maximum(in_camera[:, 2], 1e-6)
        u, v = camera.fx * in_camera[:, 0] / z + camera.cx, camera.fy * in_camera[:, 1] / z + camera.cy
        return (
            (in_camera[:, 2] > 0)
            & (np.abs(u - (camera.width - 1) / 2) <= (camera.width - 1) / 2 - margin)
            & (np.abs(v - (camera.height - 1) / 2) <= (camera.height - 1) / 2 - margin)
        )

    def with_pose(self, T_world_camera: Float[np.ndarray, "4 4"]) -> Keyframe:
        """Return the keyframe with another camera pose."""
        return replace(self, frame=with_pose(self.frame, T_world_camera))

    def without_landmarks(self, ids: Collection[int]) -> Keyframe:
        """Return the keyframe without its observations of some landmarks."""
        return replace(self, landmark_of={k: id for k, id in self.landmark_of.items() if id not in ids})

    def mask(self, id: int) -> Bool[np.ndarray, "h w"]:
        """Return the mask of a landmark that the keyframe observes."""
        return self.labels == next(label for label, other in self.landmark_of.items() if other == id)

    def observation(self, id: int) -> ObjectObservation:
        """Return the observation of a landmark; pixels that other masks may occlude are ignored."""
        mask = self.mask(id)
        others = (self.labels != BACKGROUND) & ~mask
        ignore = hidden_by(self.frame, mask, [others]) if others.any() else None
        return ObjectObservation(self.frame, mask, ignore, self.yaw_probabilities.get(id, np.zeros(0)))


def view_angle(
    centre: Float[np.ndarray, "3"], T_a: Float[np.ndarray, "4 4"], T_b: Float[np.ndarray, "4 4"]
) -> float:
    """Return the angle at a point between the directions to two cameras, in radians."""
    a, b = T_a[:3, 3] - centre, T_b[:3, 3] - centre
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.arccos(np.clip(cosine, -1, 1)))


def is_new_viewpoint(
    T_world_camera: Float[np.ndarray, "4 4"],
    visible: Mapping[int, Landmark],
    keyframes: Sequence[Keyframe],
    min_angle: float = MIN_VIEW_ANGLE,
) -> bool:
    """Return whether the viewpoint on some landmark differs from that of every keyframe that observes it.

    Args:
        T_world_camera: Pose of the camera.
        visible: Landmarks visible in its frame, by id.
        keyframes: All keyframes.
        min_angle: Angle above which viewpoints differ, in radians.
    """
    for id, landmark in visible.items():
        centre = landmark.state.pose.translation
        angles = [
            view_angle(centre, T_world_camera, key.T_world_camera)
            for key in keyframes
            if id in key.landmark_ids
        ]
        if not angles or min(angles) > min_angle:
            return True
    return False


def select_window(
    newest: Keyframe, keyframes: Sequence[Keyframe], landmarks: Mapping[int, Landmark], size: int = 3
) -> list[Keyframe]:
    """Return the newest keyframe and the ``size - 1`` nearest others that share landmarks, oldest first.

    The distance is the mean viewing angle on the shared landmarks over the square root of their number.
    """

    def distance(other: Keyframe) -> float:
        shared = [id for id in newest.landmark_ids & other.landmark_ids if id in landmarks]
        if not shared:
            return np.inf
        centres = [landmarks[id].state.pose.translation for id in shared]
        angles = [view_angle(c, newest.T_world_camera, other.T_world_camera) for c in centres]
        return float(np.mean(angles)) / len(shared) ** 0.5

    others = [key for key in keyframes if key is not newest and np.isfinite(distance(key))]
    nearest = sorted(others, key=distance)[: size - 1]
    return sorted([*nearest, newest], key=lambda key: key.number)
