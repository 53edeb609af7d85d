"""Candidates that the detector segmented but gave no class, associated across views for the fits to decide.

The class network has learned upright objects; lying ones and those on their rim often get no class from it,
although their masks are good. Fits in all classes and resting poses, and the acceptance model, decide whether
such a candidate is an object.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.detection.association import AssociationConfig, fuse_views
from perception.detection.geometry import points_of
from perception.detection.left_out import LeftOut
from perception.types import ObjectDetection, RgbdFrame, SupportPlane, unclassified

SAME = 0.3  # share of the smaller mask from which on a candidate belongs to a detected object
MIN_VIEWS = 2  # that show a candidate, where there are as many
MAX_HEIGHT = 0.14  # [m] above the support of an object that lies or stands on its rim
# Neither a missing detection nor a weak score speaks against what has no class.
_ASSOCIATION = AssociationConfig(miss_probability=0.5, single_view_score=0.0, independence=1.0)


def associate_unclassified(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Sequence[Sequence[ObjectDetection]],
    left_out: Sequence[LeftOut],
    plane: SupportPlane,
) -> list[list[ObjectDetection]]:
    """Return candidates of no class as detections, all classes equally probable, for each frame.

    Args:
        frames: Views with camera poses.
        detections_per_frame: Associated detections of each frame.
        left_out: Candidates that are not among them; what was judged before in half of its views is none.
        plane: Support plane.

    Returns:
        Detections of candidates that at least ``MIN_VIEWS`` views show. Their ``instance_id`` are above those
        of the detected objects.
    """
    rows: list[list[ObjectDetection]] = [[] for _ in frames]
    for candidate in left_out:
        known = [found.mask for found in detections_per_frame[candidate.frame]]
        is_known = any(_overlap(candidate.mask, mask) > SAME for mask in known)
        if is_open(candidate) and not is_known:
            rows[candidate.frame].append(unclassified(candidate.mask))
    ids = [found.instance_id for row in detections_per_frame for found in row]
    first = 1 + max((i for i in ids if i is not None), default=-1)
    return _without_judged(associate_candidates(frames, rows, plane, first), left_out)


def is_open(candidate: LeftOut) -> bool:
    """Return whether the class network alone left a candidate out, so that its fits may decide."""
    return candidate.reason == "of none of the classes"


def _without_judged(
    rows: Sequence[Sequence[ObjectDetection]], left_out: Sequence[LeftOut]
) -> list[list[ObjectDetection]]:
    """Return the detections of the instances of which less than half of the views were judged before.

    Fits to the other views alone would know less than those before did.
    """
    judged = [[c.mask for c in left_out if c.frame == k and c.was_judged] for k in range(len(rows))]
    views = Counter(found.instance_id for row in rows for found in row)
    before = Counter(
        found.instance_id
        for row, masks in zip(rows, judged, strict=True)
        for found in row
        if any(_overlap(found.mask, mask) > SAME for mask in masks)
    )
    return [
        [found for found in row if 2 * before[found.instance_id] < views[found.instance_id]] for row in rows
    ]


def associate_candidates(
    frames: Sequence[RgbdFrame],
    rows: Sequence[Sequence[ObjectDetection]],
    plane: SupportPlane,
    first_id: int,
) -> list[list[ObjectDetection]]:
    """Return those detections of no class that at least ``MIN_VIEWS`` views show, with ids from ``first_id``.

    Args:
        frames: Views with camera poses.
        rows: Detections of no class of each frame.
        plane: Support plane.
        first_id: Least id.
    """
    fused, _ = fuse_views(frames, rows, plane, _ASSOCIATION)
    views = Counter(found.instance_id for row in fused for found in row)
    enough = sorted(i for i, n in views.items() if i is not None and n >= min(MIN_VIEWS, len(frames)))
    number = {i: first_id + k for k, i in enumerate(enough)}
    return [
        [replace(found, instance_id=number[i]) for found in row if (i := found.instance_id) in number]
        for row in fused
    ]


def is_low(
    frames: Sequence[RgbdFrame],
    rows: Sequence[Sequence[ObjectDetection]],
    instance_id: int,
    plane: SupportPlane,
) -> bool:
    """Return whether an instance is low enough, in most views, to lie or to stand on its rim."""
    clouds = [
        points_of(frame, d.mask)
        for frame, row in zip(frames, rows)
        for d in row
        if d.instance_id == instance_id
    ]
    tops = [np.quantile(plane.height_above(cloud), 0.98) for cloud in clouds if len(cloud)]
    return bool(tops) and bool(np.median(tops) < MAX_HEIGHT)


def _overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection of two masks as a share of the smaller one: parts and mergers count as well."""
    return float((first & second).sum() / max(min(first.sum(), second.sum()), 1))
