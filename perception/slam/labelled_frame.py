"""A frame together with its instance masks and their association with landmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, UInt8

from perception.types import ObjectDetection, RgbdFrame

BACKGROUND = 0  # label of pixels outside all masks; detection k has label k + 1
MAX_LABELS = 255

LabelImage = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True)
class LabelledFrame:
    """One frame with its masks as a label image.

    Attributes:
        number: Index of the frame in the sequence.
        frame: Images, and the best known camera pose (None if there is none).
        detections: Detections of the frame; the mask of detection k has label k + 1.
        labels: Label image, ``BACKGROUND`` outside all masks.
        landmark_of: Landmark id of each associated label.
    """

    number: int
    frame: RgbdFrame
    detections: Sequence[ObjectDetection]
    labels: LabelImage
    landmark_of: Mapping[int, int] = field(default_factory=dict)

    @staticmethod
    def of(number: int, frame: RgbdFrame, detections: Sequence[ObjectDetection]) -> LabelledFrame:
        """Label the masks; none of them is associated with a landmark yet."""
        return LabelledFrame(number, frame, detections, label_image(detections, frame.depth.shape))

    @property
    def T_world_camera(self) -> Float[np.ndarray, "4 4"]:
        assert self.frame.T_world_camera is not None
        return self.frame.T_world_camera

    @property
    def landmark_ids(self) -> set[int]:
        """Ids of the landmarks that are visible in the frame."""
        return set(self.landmark_of.values())

    def with_pose(self, T_world_camera: Float[np.ndarray, "4 4"]) -> LabelledFrame:
        """Return the same frame with another camera pose."""
        return replace(self, frame=with_pose(self.frame, T_world_camera))

    def without_landmarks(self, ids: set[int]) -> LabelledFrame:
        """Return the frame without its associations with some landmarks."""
        return replace(self, landmark_of={k: id for k, id in self.landmark_of.items() if id not in ids})

    def associated(self, landmark_of: Mapping[int, int]) -> LabelledFrame:
        """Return the frame with an association in which every landmark has a single label.

        Labels of several masks of one landmark are merged into the label of the first.
        """
        label_of: dict[int, int] = {}
        table = np.arange(MAX_LABELS + 1, dtype=np.uint8)
        for label, id in landmark_of.items():
            table[label] = label_of.setdefault(id, label)
        return replace(
            self, labels=table[self.labels], landmark_of={label: id for id, label in label_of.items()}
        )


def label_image(detections: Sequence[ObjectDetection], shape: tuple[int, int]) -> LabelImage:
    """Return an image in which the mask of detection k has label k + 1; smaller masks cover larger ones."""
    labels = np.full(shape, BACKGROUND, np.uint8)
    order = range(min(len(detections), MAX_LABELS))
    for k in sorted(order, key=lambda k: -np.count_nonzero(detections[k].mask)):
        labels[detections[k].mask] = k + 1
    return labels


def with_pose(frame: RgbdFrame, T_world_camera: Float[np.ndarray, "4 4"]) -> RgbdFrame:
    """Return the frame with another camera pose."""
    return RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics, T_world_camera)
