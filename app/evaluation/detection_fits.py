"""Detections of one image after their reconstruction, as ``nodeslam reconstruct`` reports them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.detection.detector import DetectorConfig
from perception.inference.acceptance import AcceptanceModel
from perception.inference.reconstruct import ReconstructOptions, reconstruct
from perception.inference.shape_model import Decoder
from perception.types import CATEGORIES, OTHER, ObjectDetection, RgbdFrame, SupportPlane


def judged_by_fits(
    frame: RgbdFrame,
    found: Sequence[ObjectDetection],
    plane: SupportPlane,
    decoder: Decoder,
    model: AcceptanceModel,
) -> list[ObjectDetection]:
    """Return the detections with the class of their reconstruction, 'other' where it is rejected or fails.

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
    kept = {e.id: e for e in reconstruct([frame], [tried], decoder, plane, options=options)}
    judged = []
    for k, detection in enumerate(found):
        label = CATEGORIES.index(kept[k].category) if k in kept else OTHER
        probabilities = np.eye(OTHER + 1)[label]
        if k in kept:
            detection = replace(detection, category=kept[k].category, score=kept[k].score)
        judged.append(replace(detection, class_probabilities=probabilities))
    return judged


def _is_candidate(detection: ObjectDetection) -> bool:
    """Return whether the detector's default configuration reports the detection."""
    return bool(detection.class_probabilities[OTHER] <= DetectorConfig().max_other)
