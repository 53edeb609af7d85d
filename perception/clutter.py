"""Objects of cluttered tables: lying, upside-down and stacked ones besides those that the detector names.

The networks know upright objects. Lying ones and those on their rim often get no class, although their masks
are good: such candidates are fitted in all classes and resting poses and kept where the evidence is clear.
Stacks are segmented as one thing, with a class or without: what no single shape explains is cut in parts.
So are things that touch: what has no class is cut where its surface is concave, for lying objects in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.depth_cleaning import clean_frame
from perception.detection.completion import PoseNamer, posed_detections
from perception.detection.left_out import LeftOut
from perception.detection.parts import parts_of_things
from perception.detection.unclassified import associate_unclassified, is_low
from perception.inference.acceptance import AcceptanceModel
from perception.inference.explanation import unexplained
from perception.inference.handle import with_seen_handles
from perception.inference.hidden_support import on_hidden_supports
from perception.inference.lost_parts import with_lost_parts
from perception.inference.reconstruct import (
    ReconstructOptions,
    gather_instances,
    mean_poses,
    reconstruct,
)
from perception.inference.recutting import Recutting, instance_ids
from perception.inference.selection import (
    PIECE_SCORE,
    without_parts,
    without_repeated_stacks,
    without_repetitions,
)
from perception.inference.shape_model import Decoder
from perception.inference.stack_parts import (
    CLEARLY,
    DOUBTFUL,
    Rows,
    instance_points,
    split_stacks,
)
from perception.obstacles.attached import carriers_of_parts
from perception.obstacles.crossed import crossed
from perception.obstacles.handleless import mugs_without_handle
from perception.obstacles.same_colour import SAME_COLOUR, continued_in_colour
from perception.threads import single_threaded
from perception.types import (
    CATEGORIES,
    OTHER,
    POSED_CLASSES,
    ObjectDetection,
    ObjectEstimate,
    PosedClass,
    RejectedObject,
    RgbdFrame,
    SupportPlane,
    unclassified,
)

UNCLASSIFIED_SCORE = 0.55  # least score of the fit of a candidate that the detector gave no class, upright
POSED_SCORE = 0.85  # the same in other poses: what is no object most often resembles lying ones
# The same of lying bottles, with the odds of their score times (length / LENGTH) ** LENGTH_POWER: pieces of
# things are shorter. Score and length of 118 true and 76 false fits in 70 scans of training families.
BOTTLE_SCORE, LENGTH, LENGTH_POWER = 0.7, 0.12, 4.2
THINNEST = 0.021  # [m] radius of one: bottles have 25 mm and more, the handles of things 18 mm
UNCERTAIN = 0.4  # score of several views below which a detected object is more often a thing of no class
POSSIBLE = 0.05  # probability in some view below which the class network rules a class out
TURNED_MUGS: tuple[PosedClass, ...] = (("mug", "upside-down"), ("mug", "lying"))
TURNED = 0.3  # least probability of a mug that lies or stands upside down, whose handle is looked for
CARRIES = "something that belongs to none of the classes is attached to it"
CROSSED = "something that belongs to none of the classes goes through it"
HANDLELESS = "it has no handle where a mug has one, but goes on in a thing of no class"
WORSE = 0.1  # by which the score of a lying object with the parts that its mask lacked may be lower


def reconstruct_clutter(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Rows,
    left_out: Sequence[LeftOut],
    decoder: Decoder,
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    options: ReconstructOptions = ReconstructOptions(),
) -> list[ObjectEstimate]:
    """Reconstruct detected objects, candidates of no class, and the parts of stacks, ordered by id.

    Candidates and parts that are not kept are not reported as rejected.

    Args:
        frames: Views with camera poses.
        detections_per_frame: Associated detections of each frame.
        left_out: Candidates that are not among them.
        decoder: Shape prior.
        planes: Support planes, numbered by ``ObjectDetection.support``; the first is the main one.
        completer: Names the parts of stacks.
        options: Scheduling and progress.
    """
    more = associate_unclassified(frames, detections_per_frame, left_out, planes[0])
    detections_per_frame = _without_fragments(frames, detections_per_frame, left_out, options)
    with single_threaded():
        more = posed_detections(frames, more, planes, completer)
        detections_per_frame = posed_detections(frames, detections_per_frame, planes, completer)
    candidates = instance_ids(more)
    rows = [[*row, *others] for row, others in zip(detections_per_frame, more, strict=True)]
    low = {id for id in candidates if is_low(frames, more, id, planes[0])}
    judged = [[d for d in row if d.instance_id not in candidates - low] for row in rows]
    rejected: list[RejectedObject] = []
    quiet = replace(options, on_rejected=rejected.append, tentative=candidates)
    estimates = {
        e.id: e
        for e in reconstruct(frames, judged, decoder, planes, options=quiet)
        if e.id not in candidates or _is_clear(e)
    }

    def fit(parts: Rows, rests_on: Mapping[int, int]) -> list[ObjectEstimate]:
        silent = replace(
            options,
            on_rejected=None,
            on_step=None,
            progress=None,
            tentative=instance_ids(parts),
            rests_on=rests_on,
            starts=(),
        )
        return reconstruct(frames, parts, decoder, planes, options=silent)

    with single_threaded():
        stacks = split_stacks(frames, rows, estimates, planes, completer, fit)
        stacks = without_repeated_stacks(frames, rows, stacks)
        parts = [part for pair in stacks.values() for part in pair]
        single = {id: estimate for id, estimate in estimates.items() if id not in stacks}
        lost = candidates - set(single) - set(stacks)
        recutting = Recutting(frames, planes, completer, lambda cut: fit(cut, {}))
        free = 1 + max((*instance_ids(rows), *(part.id for part in parts)), default=-1)
        rows, pieces = recutting.separated(rows, lost, free)
        single |= {
            id: e
            for id, e in pieces.items()
            if e.resting == "lying" and e.score >= PIECE_SCORE and not _is_thin(e)
        }
        candidates |= instance_ids(rows) - instance_ids(detections_per_frame)
        free = max(free, 1 + max(instance_ids(rows), default=-1))
        rows, wholes = recutting.joined(rows, candidates - set(stacks), single, free)
        remaining = instance_ids(rows)
        single = {id: e for id, e in single.items() if id in remaining} | wholes
        candidates |= set(wholes)
        single = without_parts(frames, rows, single, candidates)
        if options.acceptance is not None:
            named = {d.instance_id: planes[d.support] for row in detections_per_frame for d in row}
            instances = gather_instances(frames, rows, options.max_views)
            alone = [views for views in instances if views.id in named and views.id not in stacks]
            single |= on_hidden_supports(alone, single, named, decoder, options.acceptance)
        single |= renamed(frames, detections_per_frame, single, lambda doubtful: fit(doubtful, {}))
        single |= completed(frames, rows, single, planes[0], lambda whole: fit(whole, {}))
        single = without_repetitions(frames, rows, single, candidates, parts)
        uncertain = {
            id: e
            for id, e in single.items()
            if e.n_views > 1 and _existence(e, detections_per_frame, options.acceptance) < UNCERTAIN
        }
        rejected += [_left_out(estimate) for estimate in uncertain.values()]
        single = {id: estimate for id, estimate in single.items() if id not in uncertain}
        found = with_seen_handles([*single.values(), *parts], frames, planes[0], completer)
        found, left = _without_parts_of_things(found, [*stacks.values()], frames, planes[0])
        rejected += [item for item in left if item.id in single]
    if options.on_rejected is not None:
        for item in rejected:
            if item.id not in candidates and item.id not in stacks:
                options.on_rejected(item)
    return sorted(found, key=lambda e: e.id)


def _existence(estimate: ObjectEstimate, rows: Rows, model: AcceptanceModel | None) -> float:
    """Return the probability that an object is one of the classes; of others than upright ones the score."""
    own = (d.class_probabilities for row in rows for d in row if d.instance_id == estimate.id)
    p = next(own, np.zeros(0))
    if model is None or not p.size or np.ptp(p) == 0 or estimate.resting != "upright":
        return estimate.score
    return model.existence(estimate.score, estimate.category, p)


def _left_out(estimate: ObjectEstimate) -> RejectedObject:
    reason = f"score {estimate.score:.2f} over all views: it is taken for a thing of no class"
    return RejectedObject(estimate.id, estimate.category, reason, estimate.score)


def _without_parts_of_things(
    found: Sequence[ObjectEstimate],
    stacks: Sequence[Sequence[ObjectEstimate]],
    frames: Sequence[RgbdFrame],
    plane: SupportPlane,
) -> tuple[list[ObjectEstimate], list[RejectedObject]]:
    """Return the objects without those that go on in things of no class, and these; stacks go as a whole."""
    views = [clean_frame(frame) for frame in frames]
    reasons = dict.fromkeys(carriers_of_parts(found, views, plane), CARRIES)
    reasons |= dict.fromkeys(mugs_without_handle(found, views, plane), HANDLELESS)
    reasons |= dict.fromkeys(continued_in_colour(found, views, plane), SAME_COLOUR)
    reasons |= dict.fromkeys(crossed(found, views, plane), CROSSED)
    for stack in stacks:
        known = [reasons[part.id] for part in stack if part.id in reasons]
        reasons |= {part.id: known[0] for part in stack if known}
    left = [
        RejectedObject(e.id, e.category, reasons[e.id], e.score, is_part=True)
        for e in found
        if e.id in reasons
    ]
    return [e for e in found if e.id not in reasons], left


def _without_fragments(
    frames: Sequence[RgbdFrame], rows: Rows, left_out: Sequence[LeftOut], options: ReconstructOptions
) -> Rows:
    """Return the detections, those of parts of things without an id, so that they only occlude others."""
    fragments = parts_of_things(frames, rows, left_out)
    named = {d.instance_id: d for row in rows for d in row if d.instance_id in fragments}
    if options.on_rejected is not None:
        for id in sorted(fragments):
            reason = "its surface goes on in a thing of no class"
            options.on_rejected(RejectedObject(id, named[id].category, reason, named[id].score, is_part=True))
    return [[replace(d, instance_id=None) if d.instance_id in fragments else d for d in row] for row in rows]


def renamed(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    fit: Callable[[Rows], Sequence[ObjectEstimate]],
) -> dict[int, ObjectEstimate]:
    """Return estimates of detected objects that another class in another pose explains clearly better.

    A mug upside down, for instance, is named a can by the networks, and its handle is left unexplained. What
    stands upright is of no class that the class network rules out.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame.
        estimates: Estimates with the classes of the detections, by id.
        fit: Reconstructs instances; detections without an id only occlude others.
    """
    known = instance_ids(rows)
    points = {id: instance_points(frames, rows, id) for id in estimates if id in known}
    before = {id: unexplained(points[id], [estimates[id]]) for id in points}
    doubtful = {id for id, share in before.items() if share > DOUBTFUL}
    if not doubtful:
        return {}
    nameless = [
        [
            replace(unclassified(d.mask, d.instance_id), pose_probabilities=d.pose_probabilities)
            if d.instance_id in doubtful
            else replace(d, instance_id=None)
            for d in row
        ]
        for row in rows
    ]
    return {
        e.id: e
        for e in fit(nameless)
        if _is_clear(e)
        and not _is_ruled_out(e, rows)
        and unexplained(points[e.id], [e]) < CLEARLY * before[e.id]
    }


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
    masks = with_lost_parts(frames, rows, estimates, turned, plane) if turned else {}
    if not masks:
        return {}
    whole = [[_extended(d, masks, k) for d in row] for k, row in enumerate(rows)]
    points = {id: instance_points(frames, whole, id) for id in masks}
    before = {id: unexplained(points[id], [estimates[id]]) for id in masks}
    return {
        e.id: e
        for e in fit(whole)
        if _is_completed(estimates[e.id], e, before[e.id], unexplained(points[e.id], [e]))
    }


def _is_completed(old: ObjectEstimate, new: ObjectEstimate, before: float, after: float) -> bool:
    """Return whether a fit with the lost parts replaces the one without, given what they leave unexplained.

    A handle tells a mug; what touches a lying bottle or can may be another thing.
    """
    if new.category == "mug":
        return after < before
    same_kind = old.category in ("bottle", "can") and new.category in ("bottle", "can")
    is_as_good = new.resting == old.resting == "lying" and new.score > old.score - WORSE
    return same_kind and is_as_good and after < CLEARLY * before


def _is_clear(estimate: ObjectEstimate) -> bool:
    """Return whether the score suffices for an object that the detector gave no class."""
    if estimate.resting == "upright":
        return estimate.score >= UNCLASSIFIED_SCORE
    if (estimate.category, estimate.resting) == ("bottle", "lying"):
        odds = estimate.score / max(1 - estimate.score, 1e-9) * (estimate.height / LENGTH) ** LENGTH_POWER
        is_likely = estimate.score >= UNCERTAIN and odds >= BOTTLE_SCORE / (1 - BOTTLE_SCORE)
        return is_likely and not _is_thin(estimate)
    return estimate.score >= POSED_SCORE


def _is_thin(estimate: ObjectEstimate) -> bool:
    """Return whether a bottle is thinner than bottles are."""
    return estimate.category == "bottle" and estimate.radius < THINNEST


def _may_be_turned_mug(estimate: ObjectEstimate, rows: Rows) -> bool:
    """Return whether an object is a mug that does not stand upright, or is named one by the pose network."""
    if estimate.category == "mug" and estimate.resting != "upright":
        return True
    views = [d.pose_probabilities for row in rows for d in row if d.instance_id == estimate.id]
    mean = mean_poses([p for p in views if p.size])
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
