"""Further rounds of a task: what is left on the table is looked at, planned and placed again.

What the first scan could not see behind or below other objects stands free once these are packed, what fell
lies somewhere else, and what was named wrongly is seen from all sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from manipulation.packing_problem import placed_later, resting_on
from manipulation.types import Box, ObjectOutcome, StandingObject, TaskPlan
from perception.obstacles.obstacle import PerceivedObstacle
from perception.types import ObjectEstimate

if TYPE_CHECKING:
    from app.task.task_types import TaskResult

COVERED = "what rests on it is packed first, then it is looked at again"
NOT_FOUND_AGAIN = "what came before it was packed, but it was not recognised again"
SAME_OBJECT = 0.03  # [m] between an estimate and an object on a row, within which it is that
SAME_PLACE = 0.06  # [m] between a new estimate and one of the round before, within which it replaces that


def is_something_left(result: TaskResult, latest: Sequence[ObjectOutcome]) -> bool:
    """Return whether anything but the packed objects was seen, and another round may help.

    It may where the last one has changed the table, or where something waits for it.

    Args:
        result: results of all rounds so far.
        latest: outcomes of the last one.
    """
    assert result.plan is not None
    is_left = is_something_unplaced(result) or result.rejected or result.obstacles
    waits = COVERED in result.plan.left_out.values()
    return bool(is_left) and (waits or has_changed(latest))


def places_of_left(outcomes: Sequence[ObjectOutcome], box: Box | None) -> list[tuple[float, float]]:
    """Return the places (x, y) [m] on the table where objects were left that could not be placed.

    Args:
        outcomes: outcomes of a round.
        box: the box, in which nothing is looked for.
    """
    left = [o.T_world_left for o in outcomes if not o.placed and o.T_world_left is not None]
    return [(float(T[0, 3]), float(T[1, 3])) for T in left if box is None or not box.contains(T)]


def is_something_unplaced(result: TaskResult) -> bool:
    """Return whether an object has no goal, or is not there."""
    assert result.plan is not None
    return bool(result.plan.left_out) or any(not outcome.placed for outcome in result.outcomes)


def has_changed(outcomes: Sequence[ObjectOutcome]) -> bool:
    """Return whether a round has changed the table; if not, nothing need wait for the next one."""
    return any(outcome.attempts for outcome in outcomes)


def without_covered(plan: TaskPlan, objects: Sequence[ObjectEstimate]) -> TaskPlan:
    """Return a plan without goals of what carries other objects that have one: the next round sees it whole.

    Of what is below or in another object, class and shape are the least certain. Bowls that were to be put in
    such a bowl come after it. The places of all of them stay free.

    Args:
        plan: plan of a round that is not the last.
        objects: its objects, with what they rest on.
    """
    later = placed_later(resting_on(objects), {goal.name: goal.stack for goal in plan.placements})
    return replace(
        plan,
        placements=tuple(p for p in plan.placements if p.name not in later),
        left_out=dict(plan.left_out) | {name: COVERED for name in sorted(later)},
    )


def placed_items(result: TaskResult) -> dict[str, StandingObject]:
    """Return the packed objects where they are now, by name."""
    assert result.plan is not None
    return {
        outcome.name: replace(result.plan.objects[outcome.name], T_world_stand=outcome.T_world_stand)
        for outcome in result.outcomes
        if outcome.placed and outcome.T_world_stand is not None
    }


def unplaced_estimates(result: TaskResult) -> list[ObjectEstimate]:
    """Return the estimates of the objects that were not placed, where they were found."""
    placed = {outcome.id for outcome in result.outcomes if outcome.placed}
    return [estimate for estimate in result.objects if estimate.id not in placed]


def expected_pose(
    estimate: ObjectEstimate, plan: TaskPlan, outcome: ObjectOutcome
) -> Float[np.ndarray, "4 4"]:
    """Return T_world_object of a placed object; its pose in the stand frame is unchanged by execution."""
    assert outcome.T_world_stand is not None
    T_stand_object = np.linalg.inv(plan.objects[outcome.name].T_world_stand) @ estimate.T_world_object
    return outcome.T_world_stand @ T_stand_object


def stand_pose(
    estimate: ObjectEstimate, plan: TaskPlan, T_world_object: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "4 4"]:
    """Return T_world_stand of an object that was seen at another pose: the inverse of ``expected_pose``."""
    T_object_stand = np.linalg.inv(estimate.T_world_object) @ plan.objects[estimate.name].T_world_stand
    return T_world_object @ T_object_stand


def placed_estimates(result: TaskResult) -> dict[int, ObjectEstimate]:
    """Return the estimates of the placed objects where they are now, by id."""
    assert result.plan is not None
    by_id = {estimate.id: estimate for estimate in result.objects}
    return {
        outcome.id: replace(
            by_id[outcome.id], T_world_object=expected_pose(by_id[outcome.id], result.plan, outcome)
        )
        for outcome in result.outcomes
        if outcome.placed
    }


def as_first_seen(result: TaskResult, before: TaskResult) -> TaskResult:
    """Return the results with the objects where they were on the table, not where they were found in the box.

    Args:
        result: results after objects were placed again.
        before: those before that.
    """
    assert result.plan is not None
    first, items = {estimate.id: estimate for estimate in before.objects}, dict(result.plan.objects)
    for estimate in result.objects:
        if estimate.id in first and estimate.name in items:
            back = first[estimate.id].T_world_object @ np.linalg.inv(estimate.T_world_object)
            item = items[estimate.name]
            items[estimate.name] = replace(item, T_world_stand=back @ item.T_world_stand)
    objects = [first.get(estimate.id, estimate) for estimate in result.objects]
    return replace(result, objects=objects, plan=replace(result.plan, objects=items))


def renumbered(
    objects: Sequence[ObjectEstimate],
    before: Sequence[ObjectEstimate],
    box: Box | None,
    on_rows: Sequence[ObjectEstimate] = (),
) -> list[ObjectEstimate]:
    """Return the estimates beside the box and the objects on the rows, with ids after those of before."""
    first = 1 + max((estimate.id for estimate in before), default=-1)
    taken = np.array([estimate.T_world_object[:2, 3] for estimate in on_rows]).reshape(-1, 2)
    return [
        replace(
            estimate,
            id=first + estimate.id,
            rests_on=None if estimate.rests_on is None else first + estimate.rests_on,
        )
        for estimate in objects
        if (box is None or not box.contains(estimate.T_world_object))
        and not (np.linalg.norm(taken - estimate.T_world_object[:2, 3], axis=1) < SAME_OBJECT).any()
    ]


def with_round(
    result: TaskResult,
    found: Sequence[ObjectEstimate],
    plan: TaskPlan,
    outcomes: Sequence[ObjectOutcome],
    obstacles: Sequence[PerceivedObstacle],
) -> TaskResult:
    """Return the results of all rounds so far together.

    An object that was not placed is replaced by what was found in its place, and any by an estimate with its
    id. One that was to be moved in the box, and never was touched, is where it was.

    Args:
        result: results of the rounds before.
        found: estimates of this round.
        plan: plan of this round.
        outcomes: outcomes of this round.
        obstacles: things of no class as seen in this round.
    """
    assert result.plan is not None
    placed = {outcome.id for outcome in result.outcomes if outcome.placed}
    places = np.array([estimate.T_world_object[:2, 3] for estimate in found]).reshape(-1, 2)
    again = {estimate.id for estimate in found}
    kept = [
        estimate
        for estimate in result.objects
        if estimate.id not in again
        and (
            estimate.id in placed
            or not (np.linalg.norm(places - estimate.T_world_object[:2, 3], axis=1) < SAME_PLACE).any()
        )
    ]
    names = {estimate.name for estimate in kept}
    untouched = {o.name for o in outcomes if o.id in placed and not o.placed and not o.attempts}
    latest = [o for o in outcomes if o.name not in untouched]
    renewed = {o.name for o in latest}
    goals = {p.name for p in plan.placements}
    merged = replace(
        plan,
        objects=dict(plan.objects)
        | dict(result.plan.objects)
        | {estimate.name: plan.objects[estimate.name] for estimate in found if estimate.name in plan.objects},
        placements=(*(p for p in result.plan.placements if p.name in names - goals), *plan.placements),
        left_out={
            name: NOT_FOUND_AGAIN if why == COVERED else why
            for name, why in result.plan.left_out.items()
            if name in names
        }
        | dict(plan.left_out),
        obstacles=tuple(obstacles),
    )
    return replace(
        result,
        objects=[*kept, *found],
        plan=merged,
        outcomes=[*(o for o in result.outcomes if o.name in names - renewed), *latest],
        obstacles=obstacles,
    )
