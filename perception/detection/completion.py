"""Completes detections of other sources: the class where it is absent, the yaw of mugs.

A user's own detector provides masks, mostly with classes and ids. The fit of a mug needs the direction of its
handle as well, which the yaw network predicts for any mask.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np

from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane, is_unclassified

logger = logging.getLogger(__name__)

PerFrame = tuple[tuple[ObjectDetection, ...], ...]

_LEAST = 0.005  # smallest probability of a class in one view, so that a single view cannot rule it out


@runtime_checkable
class Completer(Protocol):
    """Provider of missing classes and yaws; ``perception.detection.detector.Detector`` implements it."""

    def complete(
        self, frame: RgbdFrame, plane: SupportPlane, detections: Sequence[ObjectDetection]
    ) -> list[ObjectDetection]:
        """Return the detections, in their order, with the missing classes and the missing yaws of mugs."""
        ...


class PoseNamer(Completer, Protocol):
    """Provider of classes in any resting pose as well; the detector implements it."""

    def posed(
        self, frame: RgbdFrame, plane: SupportPlane, detections: Sequence[ObjectDetection]
    ) -> list[ObjectDetection]:
        """Return the detections, in their order, with probabilities of classes in all resting poses."""
        ...


def is_complete(detection: ObjectDetection) -> bool:
    """Return whether a detection has a class and, for a mug, a yaw distribution."""
    has_yaw = detection.category != "mug" or detection.yaw_probabilities.size > 0
    return has_yaw and not is_unclassified(detection)


def complete_detections(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    planes: Sequence[SupportPlane],
    detector: Completer,
) -> PerFrame:
    """Return the detections with the missing classes and yaw distributions; given ones stay as they are.

    Unclassified detections with the same ``instance_id`` get the class of the product of their probabilities,
    and are dropped if that is 'other'.

    Args:
        frames: Images; the camera of one without a pose is the world.
        detections_per_frame: Detections of each image.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        detector: Provides the classes and yaws.
    """
    completed = tuple(
        tuple(_completed(frame, row, planes, detector))
        for frame, row in zip(frames, detections_per_frame, strict=True)
    )
    without_class = {d.instance_id for row in detections_per_frame for d in row if is_unclassified(d)}
    for instance in sorted(id for id in without_class if id is not None):
        completed = _with_common_class(completed, instance)
    return completed


def posed_detections(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    planes: Sequence[SupportPlane],
    detector: PoseNamer,
) -> PerFrame:
    """Return the detections with probabilities of classes in all resting poses.

    Args:
        frames: Images; the camera of one without a pose is the world.
        detections_per_frame: Detections of each image.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        detector: Provides the probabilities.
    """
    rows = [list(row) for row in detections_per_frame]
    for frame, row in zip(frames, rows, strict=True):
        for number in sorted({d.support for d in row}):
            at = [i for i, d in enumerate(row) if d.support == number]
            for i, found in zip(at, detector.posed(frame, planes[number], [row[i] for i in at])):
                row[i] = found
    return tuple(tuple(row) for row in rows)


def _completed(
    frame: RgbdFrame,
    detections: Sequence[ObjectDetection],
    planes: Sequence[SupportPlane],
    detector: Completer,
) -> list[ObjectDetection]:
    """Complete the detections of one image, in their order."""
    result = list(detections)
    for number in sorted({d.support for d in detections if not is_complete(d)}):
        at = [i for i, d in enumerate(detections) if d.support == number and not is_complete(d)]
        for i, found in zip(at, detector.complete(frame, planes[number], [detections[i] for i in at])):
            result[i] = found
    return result


def _with_common_class(completed: PerFrame, instance: int) -> PerFrame:
    """Give all detections of an instance the class of the product of their class probabilities."""
    stack = [d.class_probabilities for row in completed for d in row if d.instance_id == instance]
    stack = [p for p in stack if len(p) == OTHER + 1]
    if not stack:
        return completed
    log = np.sum([np.log(np.clip(p, _LEAST, 1.0)) for p in stack], axis=0)
    probabilities = np.exp(log - log.max())
    probabilities /= probabilities.sum()
    if int(log.argmax()) == OTHER:
        logger.warning("object %d is left out: its masks show none of %s", instance, ", ".join(CATEGORIES))
        return tuple(tuple(d for d in row if d.instance_id != instance) for row in completed)
    best = int(probabilities[:OTHER].argmax())
    common = {"category": CATEGORIES[best], "score": float(probabilities[best])}
    return tuple(
        tuple(
            replace(d, **common, class_probabilities=probabilities) if d.instance_id == instance else d
            for d in row
        )
        for row in completed
    )
