"""Bowls that stand beside one another in the box although they nest.

One of them may have been taken for a mug or a can while it stood in or on something else, or no way into the
other was found at first. Once everything is packed, both are in full view, and there is room for the hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from app.task.rounds import placed_estimates, placed_items
from manipulation.standing import to_standing
from manipulation.types import Box, StandingObject
from perception.inference.renaming import mistaken_bowls
from perception.pipeline import Perception
from perception.types import ObjectEstimate, SupportPlane

if TYPE_CHECKING:
    from app.task.task_types import TaskResult

ON_FLOOR = 0.01  # [m] from the base of an object to the floor of the box, up to which it stands on that


def with_bowls_named(result: TaskResult, box: Box, perception: Perception) -> TaskResult:
    """Return the results with the bowls on the floor of the box that were taken for something else.

    Args:
        result: results with images of the box and the checks made in them.
        box: the box.
        perception: the networks.
    """
    floor, items = SupportPlane(offset=box.floor), placed_items(result)
    standing = {
        id: estimate
        for id, estimate in placed_estimates(result).items()
        if id in result.checks
        and result.checks[id].status != "hidden"  # a mug's shape is not seen where a bowl stands
        and abs(items[estimate.name].T_world_stand[2, 3] - box.floor) < ON_FLOOR
    }
    bowls = mistaken_bowls(standing, result.final_frames, floor, perception.detector, perception.decoder)
    return as_seen_now(result, bowls, floor) if bowls else result


def as_seen_now(result: TaskResult, seen: Mapping[int, ObjectEstimate], floor: SupportPlane) -> TaskResult:
    """Return the results with placed objects as they were seen where they are now, of any class and size.

    The object map keeps them where and as they lay or stood when it was made.

    Args:
        result: results of all rounds so far.
        seen: estimates where the objects are now, by id.
        floor: what they stand on.
    """
    assert result.plan is not None
    plan, before, now = result.plan, {e.id: e for e in result.objects}, placed_estimates(result)
    names = {before[id].name: estimate.name for id, estimate in seen.items()}
    first: dict[int, ObjectEstimate] = {}
    items: dict[str, StandingObject] = {}
    rests: dict[str, Float[np.ndarray, "4 4"]] = {}
    for id, estimate in seen.items():
        back = before[id].T_world_object @ np.linalg.inv(now[id].T_world_object)
        item = to_standing(estimate, floor)
        T_rest = item.T_world_stand
        first[id] = replace(
            estimate,
            T_world_object=back @ estimate.T_world_object,
            resting=before[id].resting,
            rests_on=before[id].rests_on,
        )
        items[item.name] = replace(item, T_world_stand=back @ T_rest)
        rests[item.name] = T_rest
    kept = {name: item for name, item in plan.objects.items() if name not in names}
    placements = tuple(
        replace(p, name=names.get(p.name, p.name), stack=tuple(names.get(n, n) for n in p.stack))
        for p in plan.placements
    )
    grasps = {name: grasps for name, grasps in plan.grasps.items() if name not in names}
    outcomes = [
        replace(o, name=names[o.name], T_world_stand=rests[names[o.name]]) if o.name in names else o
        for o in result.outcomes
    ]
    return replace(
        result,
        objects=[first.get(estimate.id, estimate) for estimate in result.objects],
        plan=replace(plan, objects=kept | items, placements=placements, grasps=grasps),
        outcomes=outcomes,
    )
