"""Sizes of sorted objects, measured again on the rows, and what is out of order by them.

Of what lay, stood in or on something else, or carried something, a part was hidden when it was measured.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set
from typing import TYPE_CHECKING

from app.task.further_views import MOST_CLOSER
from app.task.nests import as_seen_now
from app.task.rounds import placed_estimates
from perception.inference.remeasuring import remeasured
from perception.pipeline import Perception
from perception.types import RgbdFrame, SupportPlane

if TYPE_CHECKING:
    from app.task.task_types import TaskResult

Look = Callable[[Sequence[tuple[float, float]]], Sequence[RgbdFrame]]  # from places (x, y) [m] to images
# [m] between the sizes before and after, from which on the new one counts: of what was partly hidden, and of
# what stood free, which was measured in more images.
CHANGED, CLEARLY_CHANGED = 0.002, 0.006


def partly_hidden(result: TaskResult) -> set[int]:
    """Return the ids of the placed objects that did not stand free where they were found."""
    carrying = {estimate.rests_on for estimate in result.objects}
    placed = {outcome.id for outcome in result.outcomes if outcome.placed}
    return {
        e.id
        for e in result.objects
        if e.id in placed and (e.resting != "upright" or e.rests_on is not None or e.id in carrying)
    }


def with_sizes_measured(
    result: TaskResult, hidden: Set[int], perception: Perception, look: Look
) -> TaskResult:
    """Return the results with the shapes of the placed objects as the images of the rows show them.

    Args:
        result: Results with images of the rows.
        hidden: Objects that were partly hidden where they were found.
        perception: The networks.
        look: Takes images of the objects among them that no image of the rows shows whole.
    """
    plane, placed = SupportPlane(), placed_estimates(result)
    networks = perception.detector, perception.decoder
    found = remeasured(placed, result.final_frames, plane, *networks)
    cut = sorted(hidden - found.keys())[:MOST_CLOSER]
    if cut:
        frames = look([(float(x), float(y)) for x, y in (placed[id].T_world_object[:2, 3] for id in cut)])
        found |= remeasured(placed, frames, plane, *networks, ids=cut)
    least = {id: CHANGED if id in hidden else CLEARLY_CHANGED for id in found}
    changed = {id: e for id, e in found.items() if abs(e.size - placed[id].size) > least[id]}
    return as_seen_now(result, changed, plane) if changed else result
