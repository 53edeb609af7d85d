"""Objects of cluttered tables: lying, upside-down and stacked ones besides those that the detector names.

The networks know upright objects. Lying ones and those on their rim often get no class, although their masks
are good: such candidates are fitted in all classes and resting poses and kept where the evidence is clear.
Stacks are segmented as one thing, with a class or without: what no single shape explains is cut in parts.
So are things that touch: what has no class is cut where its surface is concave, for objects in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from perception.detection.completion import PoseNamer, posed_detections
from perception.detection.left_out import LeftOut
from perception.detection.parts import parts_of_things
from perception.detection.unclassified import associate_unclassified, is_low
from perception.inference.acceptance import AcceptanceModel
from perception.inference.clear_evidence import is_clear, may_be_part, shows_ends
from perception.inference.doubtful_shapes import completed, renamed
from perception.inference.handle import with_seen_handles
from perception.inference.hidden_support import on_hidden_supports
from perception.inference.reconstruct import ReconstructOptions, gather_instances, reconstruct
from perception.inference.recutting import Recutting, instance_ids
from perception.inference.selection import (
    without_parts,
    without_repeated_stacks,
    without_repetitions,
)
from perception.inference.shape_model import Decoder
from perception.inference.stack_parts import Rows, instance_points, split_stacks
from perception.obstacles.parts_of_things import without_parts_of_things
from perception.threads import single_threaded
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane

# Least score of an upright piece of what was cut: of those in 20 scans one had more than 0.5, a bottle with
# 0.79 by one pose network and 0.86 by another.
UPRIGHT_PIECE = 0.75
UNCERTAIN = 0.4  # score in a scan below which a detected object is more often a thing of no class


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
    named = _without_fragments(frames, detections_per_frame, left_out, options)
    with single_threaded():
        more = posed_detections(frames, more, planes, completer)
        named = posed_detections(frames, named, planes, completer)
    candidates = instance_ids(more)
    rows = [[*row, *others] for row, others in zip(named, more, strict=True)]
    low = {id for id in candidates if is_low(frames, more, id, planes[0])}
    judged = [[d for d in row if d.instance_id not in candidates - low] for row in rows]
    rejected: list[RejectedObject] = []
    quiet = replace(options, on_rejected=rejected.append, tentative=candidates)
    fitted = reconstruct(frames, judged, decoder, planes, options=quiet)
    estimates = {e.id: e for e in fitted if e.id not in candidates or is_clear(e)}
    unclear = [e for e in fitted if e.id not in estimates]

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

    def name_poses(parts: Rows) -> Rows:
        return posed_detections(frames, parts, planes, completer)

    model = options.acceptance
    with single_threaded():
        weak = _uncertain(estimates, named, model)
        stacks = split_stacks(frames, rows, estimates, planes, completer, fit, options.workers, weak)
        stacks = without_repeated_stacks(frames, rows, stacks)
        parts = [part for pair in stacks.values() for part in pair]
        single = {id: estimate for id, estimate in estimates.items() if id not in stacks}
        lost = candidates - set(single) - set(stacks)
        recutting = Recutting(frames, planes, completer, lambda cut: fit(cut, {}), options.workers)

        def is_kept(e: ObjectEstimate) -> bool:
            return is_clear(e) if e.id in candidates else _existence(e, named, model) >= UNCERTAIN

        rows, agreed = recutting.agreed(rows, lost | weak - set(stacks), is_kept)
        single, lost = single | agreed, lost - set(agreed)
        free = 1 + max((*instance_ids(rows), *(part.id for part in parts)), default=-1)
        rows, parted = recutting.parted(
            rows, lost, free, lambda e, cut: _is_object(e, instance_points(frames, cut, e.id))
        )
        single, lost = single | parted, lost & instance_ids(rows)
        free = max(free, 1 + max(instance_ids(rows), default=-1))
        rows, pieces = recutting.separated(rows, lost, free)
        single |= {id: e for id, e in pieces.items() if _is_object(e, instance_points(frames, rows, id))}
        candidates |= instance_ids(rows) - instance_ids(named)
        free = max(free, 1 + max(instance_ids(rows), default=-1))
        rows, wholes = recutting.joined(rows, candidates - set(stacks), single, free)
        remaining = instance_ids(rows)
        single = {id: e for id, e in single.items() if id in remaining} | wholes
        candidates |= set(wholes)
        single = without_parts(frames, rows, single, candidates)
        if model is not None:
            support = {d.instance_id: planes[d.support] for row in named for d in row}
            instances = gather_instances(frames, rows, options.max_views)
            alone = [views for views in instances if views.id in support and views.id not in stacks]
            single |= on_hidden_supports(alone, single, support, decoder, model)
        single |= renamed(frames, named, single, name_poses, lambda doubtful: fit(doubtful, {}))
        single |= completed(frames, rows, single, planes[0], lambda whole: fit(whole, {}))
        single = without_repetitions(frames, rows, single, candidates, parts)
        uncertain = _uncertain(single, named, model)
        rejected += [_left_out(single[id]) for id in sorted(uncertain)]
        single = {id: estimate for id, estimate in single.items() if id not in uncertain}
        found = with_seen_handles([*single.values(), *parts], frames, planes[0], completer)
        found, left = without_parts_of_things(
            found, [*stacks.values()], frames, planes[0], unclear, options.workers
        )
        rejected += [item for item in left if item.id in single]
    if options.on_rejected is not None:
        for item in rejected:
            if item.id not in candidates and item.id not in stacks:
                options.on_rejected(item)
    return sorted(found, key=lambda e: e.id)


def _is_object(piece: ObjectEstimate, points: Float[np.ndarray, "n 3"]) -> bool:
    """Return whether a piece of what was cut lies or stands there as an object of its own."""
    if piece.resting == "upright":
        return piece.score >= UPRIGHT_PIECE
    return piece.resting == "lying" and not may_be_part(piece) and shows_ends(piece, points)


def _uncertain(
    estimates: Mapping[int, ObjectEstimate], rows: Rows, model: AcceptanceModel | None
) -> set[int]:
    """Return the ids of the objects that are more often things of no class; a single image tells none."""
    if len(rows) <= 1:
        return set()
    return {id for id, e in estimates.items() if _existence(e, rows, model) < UNCERTAIN}


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
