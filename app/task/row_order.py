"""Sizes of sorted objects, measured again on the rows, and what is out of order by them.

Of what lay, stood in or on something else, or carried something, a part was hidden when it was measured.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

from app.task.nests import with_new_names
from app.task.rounds import placed_estimates
from perception.inference.remeasuring import remeasured
from perception.pipeline import Perception
from perception.types import SupportPlane

if TYPE_CHECKING:
    from app.task.task_types import TaskResult

CHANGED = 0.002  # [m] between the sizes before and after, from which on the new one counts


def partly_hidden(result: TaskResult) -> set[int]:
    """Return the ids of the placed objects that did not stand free where they were found."""
    carrying = {estimate.rests_on for estimate in result.objects}
    placed = {outcome.id for outcome in result.outcomes if outcome.placed}
    return {
        e.id
        for e in result.objects
        if e.id in placed and (e.resting != "upright" or e.rests_on is not None or e.id in carrying)
    }


def with_sizes_measured(result: TaskResult, ids: Collection[int], perception: Perception) -> TaskResult:
    """Return the results with the shapes of some placed objects as the images of the rows show them.

    Args:
        result: Results with images of the rows and the checks made in them.
        ids: Objects to measure.
        perception: The networks.
    """
    plane, placed = SupportPlane(), placed_estimates(result)
    # What is much higher than estimated is not seen where it is.
    seen = {id for id in ids if id in result.checks and result.checks[id].status != "hidden"}
    found = remeasured(
        {id: placed[id] for id in seen},
        [estimate for id, estimate in placed.items() if id not in seen],
        result.final_frames,
        plane,
        perception.detector,
        perception.decoder,
    )
    changed = {id: e for id, e in found.items() if abs(e.size - placed[id].size) > CHANGED}
    return with_new_names(result, changed, plane) if changed else result
