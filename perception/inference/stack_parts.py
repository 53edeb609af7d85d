"""Objects of stacks that were segmented as one thing: cut in two, fitted, and kept if they explain more.

Things that no shape explains, or whose shape leaves measured points unexplained, may be several objects.
They are cut (``stack_cuts``) and both parts fitted, the upper one resting on the lower one. The parts replace
the whole if both are accepted and together explain clearly more of the measured points (``stack_choice``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from perception.depth_cleaning import clean_frame
from perception.detection.completion import PoseNamer
from perception.inference.explanation import unexplained
from perception.inference.observation import ObjectObservation, measured_points
from perception.inference.part_colors import ALIKE, color_overlap
from perception.inference.stack_choice import GAP, are_likely, are_one, are_two, gap_between
from perception.inference.stack_cuts import TRIALS, Parts, Rows, StackCuts
from perception.threads import worker_pool
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

Fit = Callable[[Rows, Mapping[int, int]], Sequence[ObjectEstimate]]

_POINTS = 4000


@dataclass(frozen=True)
class _PossibleStack:
    """Cuts of an instance, its measured points [m], and the share of them that a single shape leaves open."""

    cuts: Sequence[Parts]
    points: Float[np.ndarray, "n 3"]
    before: float


def split_stacks(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    planes: Sequence[SupportPlane],
    completer: PoseNamer,
    fit: Fit,
    workers: int | None = None,
    uncertain: Collection[int] = (),
) -> dict[int, tuple[ObjectEstimate, ...]]:
    """Return the lower and the upper object of each instance that is a stack, by the instance's id.

    Two cans with one axis that a bottle explains completely are that bottle, with their score.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame, those of no class included.
        estimates: Estimates of instances as single objects, by id; rejected ones are missing.
        planes: Support planes, numbered by ``ObjectDetection.support``.
        completer: Names the parts.
        fit: Reconstructs instances, given which rests on which; detections without an id only occlude others.
        workers: Number of instances cut at a time; None for the number of cores.
        uncertain: Ids of estimates that are taken for things of no class.
    """
    views = [clean_frame(frame) for frame in frames]
    cuts = StackCuts(views, rows, planes, completer)
    ids = sorted({d.instance_id for row in rows for d in row if d.instance_id is not None})
    free = 1 + max(ids, default=-1)

    def possible_stack(number: int) -> _PossibleStack:
        id, free_id = ids[number], free + 2 * number
        points, whole = instance_points(views, rows, id), estimates.get(id)
        before = unexplained(points, [] if whole is None else [whole])
        return _PossibleStack(cuts.worth_fitting(id, free_id, whole, before), points, before)

    with worker_pool(workers) as pool:
        possible = dict(zip(ids, pool.map(possible_stack, range(len(ids)))))
    found: dict[int, tuple[ObjectEstimate, ...]] = {}
    for trial in range(1 + TRIALS):
        parts = {
            id: stack.cuts[trial]
            for id, stack in possible.items()
            if trial < len(stack.cuts) and id not in found
        }
        if not parts:
            break
        above = {part.ids[1]: part.ids[0] for part in parts.values()}
        fitted = {e.id: e for e in fit(_with_parts(rows, parts), above)}
        for id, part in parts.items():
            pair, whole = [fitted[k] for k in part.ids if k in fitted], estimates.get(id)
            if len(pair) < 2 or gap_between(pair[0], pair[1], planes[0]) > GAP:
                continue
            stack = possible[id]
            if whole is not None and are_one(pair, whole, stack.before):
                found[id] = (replace(whole, score=max(whole.score, min(e.score for e in pair))),)
            elif are_two(pair, whole, stack.points, stack.before, planes[0], id in uncertain) and (
                are_likely(pair) or not _are_alike(views, part)
            ):
                found[id] = tuple(pair)
    return found


def _are_alike(views: Sequence[RgbdFrame], parts: Parts) -> bool:
    """Return whether two parts have the same colours."""
    shown = [
        [(view, d.mask) for view, row in zip(views, parts.rows) for d in row if d.instance_id == id]
        for id in parts.ids
    ]
    return color_overlap(*shown) > ALIKE


def _with_parts(rows: Rows, parts: Mapping[int, Parts]) -> Rows:
    """Return the parts in place of their wholes; all other detections without an id."""
    return [
        [replace(d, instance_id=None) for d in row if d.instance_id not in parts]
        + [d for part in parts.values() for d in part.rows[k]]
        for k, row in enumerate(rows)
    ]


def instance_points(views: Sequence[RgbdFrame], rows: Rows, id: int) -> Float[np.ndarray, "n 3"]:
    """Return a sample of an instance's measured points in the world frame, in metres."""
    masks = [(view, d.mask) for view, row in zip(views, rows) for d in row if d.instance_id == id]
    points = measured_points([ObjectObservation(*shown) for shown in masks], erode=2)
    return points[:: max(1, len(points) // _POINTS)]
