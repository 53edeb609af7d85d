"""Objects whose shape does not explain the measurements: fitted in another pose, or with lost parts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.inference.clear_evidence import is_clear
from perception.inference.explanation import unexplained
from perception.inference.lost_ends import with_lost_ends
from perception.inference.lost_parts import with_lost_parts
from perception.inference.reconstruct import mean_probabilities
from perception.inference.recutting import instance_ids
from perception.inference.stack_choice import CLEARLY, DOUBTFUL
from perception.inference.stack_parts import Rows, instance_points
from perception.inference.stray_parts import without_stray_parts
from perception.types import (
    CATEGORIES,
    OTHER,
    POSED_CLASSES,
    Category,
    ObjectDetection,
    ObjectEstimate,
    PosedClass,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

POSSIBLE = 0.05  # probability in some view below which the class network rules a class out
TURNED_MUGS: tuple[PosedClass, ...] = (("mug", "upside-down"), ("mug", "lying"))
TURNED = 0.3  # least probability of a mug that lies or stands upside down, whose handle is looked for
ROUND: Collection[Category] = ("bottle", "can")
ABOUT = 0.005  # by how much larger the unexplained share may be with an end that several views show
WORSE = 0.1  # by which the score of a lying object with the parts that its mask lacked may be lower

# Whether the second of two estimates replaces the first, given the unexplained shares of the points of both.
Replaces = Callable[[ObjectEstimate, ObjectEstimate, float, float], bool]


def renamed(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    name: Callable[[Rows], Rows],
    fit: Callable[[Rows], Sequence[ObjectEstimate]],
) -> dict[int, ObjectEstimate]:
    """Return estimates of detected objects that another class in another pose explains clearly better.

    A mug upside down, for instance, is named a can by the networks, and its handle is left unexplained. What
    their masks have of other things, across a gap, is left out. What stands upright is of no class that the
    class network rules out.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates with the classes of the detections, by id.
        name: Returns detections with probabilities of classes in all resting poses.
        fit: Reconstructs instances; detections without an id only occlude others.
    """
    known = sorted(instance_ids(rows) & estimates.keys())
    measured = {id: instance_points(frames, rows, id) for id in known}
    doubtful = [id for id in known if unexplained(measured[id], [estimates[id]]) > DOUBTFUL]
    if not doubtful:
        return {}
    rows = without_stray_parts(frames, rows, estimates, doubtful)
    points = {id: instance_points(frames, rows, id) for id in doubtful}
    before = {id: unexplained(points[id], [estimates[id]]) for id in doubtful}
    own = [[_nameless(d) for d in row if d.instance_id in doubtful] for row in rows]
    others = [[replace(d, instance_id=None) for d in row if d.instance_id not in doubtful] for row in rows]
    nameless = [[*named, *rest] for named, rest in zip(name(own), others, strict=True)]
    return {
        e.id: e
        for e in fit(nameless)
        if is_clear(e)
        and not _is_ruled_out(e, rows)
        and unexplained(points[e.id], [e]) < CLEARLY * before[e.id]
    }


def _nameless(detection: ObjectDetection) -> ObjectDetection:
    return replace(unclassified(detection.mask, detection.instance_id), support=detection.support)


def _is_ruled_out(estimate: ObjectEstimate, rows: Rows) -> bool:
    """Return whether the class network, which knows upright objects alone, denies a class in all views."""
    own = (d.class_probabilities for row in rows for d in row if d.instance_id == estimate.id)
    views = [p for p in own if len(p) == OTHER + 1]
    if estimate.resting != "upright" or not views:
        return False
    return bool(np.max(views, axis=0)[CATEGORIES.index(estimate.category)] < POSSIBLE)


def completed(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    plane: SupportPlane,
    fit: Callable[[Rows], Sequence[ObjectEstimate]],
) -> dict[int, ObjectEstimate]:
    """Return estimates of objects that do not stand upright with the parts that their masks lack.

    Without its handle a mug upside down is a can, without its cap a bottle that lies cannot be grasped.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates of all objects, by id.
        plane: Support plane.
        fit: Reconstructs instances; detections without an id only occlude others.
    """
    turned = [id for id, e in estimates.items() if e.resting == "lying" or _may_be_turned_mug(e, rows)]
    if not turned:
        return {}
    parts = with_lost_parts(frames, rows, estimates, turned, plane)
    found = _completed(frames, rows, estimates, parts, fit, _has_lost_part)
    left = [id for id in turned if id not in found and _is_round_and_lies(estimates[id])]
    ends = with_lost_ends(frames, rows, {**estimates, **found}, left, plane)
    return found | _completed(frames, rows, estimates, ends, fit, _has_lost_end)


def _completed(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    masks: Mapping[int, Sequence[np.ndarray | None]],
    fit: Callable[[Rows], Sequence[ObjectEstimate]],
    replaces: Replaces,
) -> dict[int, ObjectEstimate]:
    """Return the estimates from extended masks that replace those from the masks of the detections."""
    if not masks:
        return {}
    whole = [[_extended(d, masks, k) for d in row] for k, row in enumerate(rows)]
    points = {id: instance_points(frames, whole, id) for id in masks}
    before = {id: unexplained(points[id], [estimates[id]]) for id in masks}
    return {
        e.id: e
        for e in fit(whole)
        if replaces(estimates[e.id], e, before[e.id], unexplained(points[e.id], [e]))
    }


def _has_lost_part(old: ObjectEstimate, new: ObjectEstimate, before: float, after: float) -> bool:
    """Return whether a fit with the lost parts replaces the one without, given what they leave unexplained.

    A handle tells a mug; what touches a lying bottle or can may be another thing.
    """
    if new.category == "mug":
        return after < before
    return _is_same_kind(old, new) and after < CLEARLY * before


def _has_lost_end(old: ObjectEstimate, new: ObjectEstimate, before: float, after: float) -> bool:
    """Return the same for an end, which may be so small that it hardly counts."""
    return _is_same_kind(old, new) and after < before + ABOUT


def _is_same_kind(old: ObjectEstimate, new: ObjectEstimate) -> bool:
    """Return whether a lying bottle or can is one with its lost parts, of about the same score."""
    return _is_round_and_lies(old) and _is_round_and_lies(new) and new.score > old.score - WORSE


def _is_round_and_lies(estimate: ObjectEstimate) -> bool:
    return estimate.category in ROUND and estimate.resting == "lying"


def _may_be_turned_mug(estimate: ObjectEstimate, rows: Rows) -> bool:
    """Return whether an object is a mug that does not stand upright, or is named one by the pose network."""
    if estimate.category == "mug" and estimate.resting != "upright":
        return True
    views = [d.pose_probabilities for row in rows for d in row if d.instance_id == estimate.id]
    mean = mean_probabilities([p for p in views if p.size])
    turned = sum(p for posed, p in zip(POSED_CLASSES, mean.tolist()) if posed in TURNED_MUGS)
    return turned > TURNED


def _extended(
    detection: ObjectDetection, masks: Mapping[int, Sequence[np.ndarray | None]], frame: int
) -> ObjectDetection:
    """Return a detection with its extended mask; without its id if none of its masks is extended."""
    if detection.instance_id is None or detection.instance_id not in masks:
        return replace(detection, instance_id=None)
    mask = masks[detection.instance_id][frame]
    return detection if mask is None else replace(detection, mask=mask)
