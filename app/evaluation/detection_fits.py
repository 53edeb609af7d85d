"""Detections of one image after their reconstruction, as ``nodeslam reconstruct`` reports them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.detection.detector import DetectorConfig
from perception.inference.acceptance import AcceptanceModel
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.inference.shape_model import Decoder
from perception.obstacles.one_view import parts_of_things_in_one_view
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane


def judged_by_fits(
    frame: RgbdFrame,
    found: Sequence[ObjectDetection],
    plane: SupportPlane,
    decoder: Decoder,
    model: AcceptanceModel,
) -> tuple[list[ObjectDetection], list[float | None]]:
    """Return the detections with the class of their reconstruction, 'other' where it is rejected or fails.

    The second value is the yaw of each reconstruction in the world frame in [rad]; None without one.

    Args:
        frame: Image with its camera pose.
        found: Detections with class probabilities, those of distractors among them.
        plane: Support plane in the world frame.
        decoder: Shape prior.
        model: Scores the evidence of the fits.
    """
    tried = [
        replace(detection, instance_id=k) if _is_candidate(detection) else detection
        for k, detection in enumerate(found)
    ]
    options = ReconstructOptions(workers=1, acceptance=model)
    estimates = reconstruct([frame], [tried], decoder, plane, options=options)
    parts = parts_of_things_in_one_view(estimates, [frame], [tried], (plane,))
    kept = {e.id: e for e in estimates if e.id not in parts}
    judged: list[ObjectDetection] = []
    for k, detection in enumerate(found):
        label = CATEGORIES.index(kept[k].category) if k in kept else OTHER
        probabilities = np.eye(OTHER + 1)[label]
        if k in kept:
            detection = replace(detection, category=kept[k].category, score=kept[k].score)
        judged.append(replace(detection, class_probabilities=probabilities))
    x_axes = [kept[k].T_world_object[:2, 0] if k in kept else None for k in range(len(found))]
    return judged, [None if x is None else float(np.arctan2(x[1], x[0])) for x in x_axes]


def _is_candidate(detection: ObjectDetection) -> bool:
    """Return whether the detector's default configuration reports the detection."""
    return bool(detection.class_probabilities[OTHER] <= DetectorConfig().max_other)
