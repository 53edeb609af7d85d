"""Objects of which a single image shows that they are parts of things, such as the shaft of a shoe."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from perception.depth_cleaning import clean_frame
from perception.obstacles.same_colour import continued_in_one_view
from perception.types import OTHER, ObjectDetection, ObjectEstimate, RgbdFrame, SupportPlane

LIKELY = 0.5  # probability of no class below which a detection without an estimate may be an object


def parts_of_things_in_one_view(
    objects: Sequence[ObjectEstimate],
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    planes: Sequence[SupportPlane],
) -> set[int]:
    """Return the ids of the objects, each seen in one image alone, that are parts of things of no class.

    Objects whose class was given, without probabilities, are none.

    Args:
        objects: Object map.
        frames: Images with camera poses.
        detections_per_frame: Associated detections of each frame.
        planes: Support planes, numbered by ``ObjectDetection.support``.
    """
    parts: set[int] = set()
    for frame, row in zip(frames, detections_per_frame, strict=True):
        support = {d.instance_id: d.support for d in row if len(d.class_probabilities) == OTHER + 1}
        own = [e for e in objects if e.n_views == 1 and e.id in support]
        if not own:
            continue
        view, occupied = clean_frame(frame), _occupied(row, objects)
        for number in {support[e.id] for e in own}:
            there = [e for e in own if support[e.id] == number]
            parts |= continued_in_one_view(there, objects, view, planes[number], occupied)
    return parts


def _occupied(row: Sequence[ObjectDetection], objects: Sequence[ObjectEstimate]) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of detections without an estimate that may be objects."""
    known = {e.id for e in objects}
    masks = [d.mask for d in row if d.instance_id not in known and _may_be_object(d)]
    return np.any([np.zeros_like(row[0].mask), *masks], axis=0)


def _may_be_object(detection: ObjectDetection) -> bool:
    p = detection.class_probabilities
    return len(p) != OTHER + 1 or bool(p[OTHER] < LIKELY)
