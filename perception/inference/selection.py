"""Which of the estimates in clutter remain: none twice, and none that is a part of another thing."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from perception.detection.parts import continued_shares
from perception.inference.clear_evidence import may_be_part
from perception.inference.explanation import shared_volume, unexplained
from perception.inference.stack_parts import Rows, instance_points
from perception.types import ObjectEstimate, RgbdFrame

CONTINUED = 0.08  # share of its outline along which the surface of such a part goes on in the thing
INSIDE = 0.35  # share of an object's volume inside another from which on it is a part of that
REPEATED = 0.3  # largest unexplained share of a candidate's points if it is part of another object


def without_parts(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    candidates: Collection[int],
) -> dict[int, ObjectEstimate]:
    """Return the estimates without doubtful candidates whose surface goes on in one that no shape explains.

    The handle of a hair dryer is a lying bottle by its shape.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame, candidates included.
        estimates: Estimates by id.
        candidates: Ids of those without a class of the detector.
    """
    doubtful = {id for id, e in estimates.items() if id in candidates and may_be_part(e)}
    if not doubtful:
        return dict(estimates)
    lost = set(candidates) - estimates.keys()
    things = [[d.mask for d in row if d.instance_id in lost] for row in rows]
    own = [[d for d in row if d.instance_id in doubtful] for row in rows]
    shares = continued_shares(frames, own, things)
    parts = {id for id, seen in shares.items() if np.median(seen) > CONTINUED}
    return {id: e for id, e in estimates.items() if id not in parts}


def without_repeated_stacks(
    frames: Sequence[RgbdFrame], rows: Rows, stacks: Mapping[int, tuple[ObjectEstimate, ...]]
) -> dict[int, tuple[ObjectEstimate, ...]]:
    """Return the stacks without those whose measured points another stack explains.

    What the views show in part only may be associated as two instances, each of which is the same stack.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame.
        stacks: Parts of each instance that is a stack, by the instance's id.
    """
    kept: dict[int, tuple[ObjectEstimate, ...]] = {}
    for id in sorted(stacks, key=lambda i: (-max(e.n_views for e in stacks[i]), i)):
        others = [part for pair in kept.values() for part in pair]
        if unexplained(instance_points(frames, rows, id), others) > REPEATED:
            kept[id] = stacks[id]
    return kept


def without_repetitions(
    frames: Sequence[RgbdFrame],
    rows: Rows,
    estimates: Mapping[int, ObjectEstimate],
    candidates: Collection[int],
    parts: Sequence[ObjectEstimate] = (),
) -> dict[int, ObjectEstimate]:
    """Return the estimates without those whose measured points or volume belong to another object.

    Objects that the detector gave a class are compared with the parts of stacks alone.

    Args:
        frames: Views with camera poses.
        rows: Associated detections of each frame, candidates included.
        estimates: Estimates by id.
        candidates: Ids of those without a class of the detector.
        parts: Parts of stacks.
    """

    def is_repeated(id: int, others: Sequence[ObjectEstimate]) -> bool:
        if not others:
            return False
        if any(shared_volume(estimates[id], other) > INSIDE for other in others):
            return True
        return unexplained(instance_points(frames, rows, id), others) <= REPEATED

    kept = {id: e for id, e in estimates.items() if id not in candidates and not is_repeated(id, parts)}
    uncertain = [e for id, e in estimates.items() if id in candidates]
    for estimate in sorted(uncertain, key=lambda e: (-e.n_views, -e.score)):
        if not is_repeated(estimate.id, [*kept.values(), *parts]):
            kept[estimate.id] = estimate
    return kept
