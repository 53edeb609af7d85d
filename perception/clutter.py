"""Objects of cluttered tables: lying, upside-down and stacked ones besides those that the detector names.

The networks know upright objects. Lying ones and those on their rim often get no class, although their masks
are good: such candidates are fitted in all classes and resting poses and kept where the evidence is clear.
Stacks are segmented as one thing, with a class or without: what no single shape explains is cut in parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from perception.detection.completion import Completer
from perception.detection.left_out import LeftOut
from perception.detection.unclassified import associate_unclassified, is_low
from perception.inference.reconstruct import ReconstructOptions, reconstruct, single_threaded_torch
from perception.inference.shape_model import Decoder
from perception.inference.stack_parts import Rows, split_stacks
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame, SupportPlane

UNCLASSIFIED_SCORE = 0.55  # least score of the fit of a candidate that the detector gave no class


def reconstruct_clutter(
    frames: Sequence[RgbdFrame],
    detections_per_frame: Rows,
    left_out: Sequence[LeftOut],
    decoder: Decoder,
    planes: Sequence[SupportPlane],
    completer: Completer,
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
    candidates = {d.instance_id for row in more for d in row if d.instance_id is not None}
    rows = [[*row, *others] for row, others in zip(detections_per_frame, more, strict=True)]
    low = {id for id in candidates if is_low(frames, more, id, planes[0])}
    judged = [[d for d in row if d.instance_id not in candidates - low] for row in rows]
    rejected: list[RejectedObject] = []
    quiet = replace(options, on_rejected=rejected.append, tentative=candidates)
    estimates = {
        e.id: e
        for e in reconstruct(frames, judged, decoder, planes, options=quiet)
        if e.id not in candidates or e.score >= UNCLASSIFIED_SCORE
    }

    def fit(parts: Rows, rests_on: Mapping[int, int]) -> list[ObjectEstimate]:
        ids = {d.instance_id for row in parts for d in row if d.instance_id is not None}
        silent = replace(
            options, on_rejected=None, on_step=None, progress=None, tentative=ids, rests_on=rests_on
        )
        return reconstruct(frames, parts, decoder, planes, options=silent)

    with single_threaded_torch():
        stacks = split_stacks(frames, rows, estimates, planes, completer, fit)
    if options.on_rejected is not None:
        for item in rejected:
            if item.id not in candidates and item.id not in stacks:
                options.on_rejected(item)
    single = [estimate for id, estimate in estimates.items() if id not in stacks]
    return sorted([*single, *(part for pair in stacks.values() for part in pair)], key=lambda e: e.id)
