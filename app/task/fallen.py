"""What does not stand in the box as it was placed: knocked over by what came later, leaning, or turned.

Shapes are known; only poses are estimated again, in the images of the box that verify the task.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from app.task.obstacles import box_interior
from app.task.rounds import expected_pose, placed_estimates, stand_pose
from app.task.task_types import TaskResult
from manipulation.lying_grasps import is_upside_down, lies
from manipulation.observation import turn_between
from manipulation.types import Box, ObjectOutcome, StandingObject
from perception.geometry import levelled
from perception.inference.depth_votes import SearchScene
from perception.inference.refit import PoseCheck
from perception.inference.relocate import relocate
from perception.types import ObjectEstimate, RestingPose, RgbdFrame

LEANING = np.deg2rad(15.0)  # tilt of what counts as leaning; images show it to a few degrees
# Of a handle from its goal, and between two, from which on they are not in line: two that were seen to differ
# by 11 degrees differed by 17.
TURNED, APART = np.deg2rad(12.0), np.deg2rad(10.0)
AGREES = 0.65  # share of the visible pixels from which on an object is surely where it was placed
BETTER = 0.1  # by which another pose in the box must explain more of them
GONE = "it was placed, but is not in the box any more"


def fallen_objects(
    placed: Mapping[int, ObjectEstimate],
    checks: Mapping[int, PoseCheck],
    frames: Sequence[RgbdFrame],
    box: Box,
) -> list[ObjectEstimate]:
    """Return what lies or leans in the box, and mugs that were turned, at their poses there, by ascending id.

    What is not seen at all where it was placed, nor elsewhere in the box, is not among them.

    Args:
        placed: Estimates of the placed objects at their expected poses, by id.
        checks: Their pose checks.
        frames: Images of the box.
        box: The box.
    """
    doubtful = {id for id, check in checks.items() if _is_doubtful(check)}
    now = {
        id: replace(placed[id], T_world_object=check.T_world_object)
        for id, check in checks.items()
        if check.status != "not_there"
    }
    found: list[ObjectEstimate] = []
    for id in sorted(doubtful):
        before, others = checks[id], [now[other] for other in sorted(now) if other != id]
        scene = SearchScene(frames, box_interior(box), others)
        anywhere = relocate(placed[id], scene, T_before=placed[id].T_world_object)
        least = before.inlier_share + BETTER if before.status == "seen" else 0.0
        check = anywhere if anywhere is not None and anywhere.inlier_share > least else before
        if check.status == "seen" and check.tilt > LEANING:
            now[id] = _resting(placed[id], check.T_world_object, others)
            found.append(now[id])
    mugs = {id: placed[id] for id in checks.keys() - doubtful if placed[id].category == "mug"}
    for id in _out_of_line(mugs, checks):
        upright = levelled(checks[id].T_world_object, placed[id].T_world_object[2, 3])
        found.append(replace(placed[id], T_world_object=upright, resting="upright", rests_on=None))
    return sorted(found, key=lambda estimate: estimate.id)


def without_gone(result: TaskResult, box: Box) -> TaskResult:
    """Return the results without the places of objects that are not in the box any more.

    Args:
        result: results with images of the box and the checks made in them.
        box: the box.
    """
    placed = placed_estimates(result)
    missing = {id for id in placed.keys() & result.checks.keys() if result.checks[id].status == "not_there"}
    if not missing:
        return result
    others = [estimate for id, estimate in placed.items() if id not in missing]
    scene = SearchScene(result.final_frames, box_interior(box), others)
    gone = {id for id in missing if relocate(placed[id], scene) is None}
    if not gone:
        return result
    outcomes = [
        replace(o, placed=False, reason=GONE, T_world_stand=None) if o.id in gone else o
        for o in result.outcomes
    ]
    checks = {id: check for id, check in result.checks.items() if id not in gone}
    return replace(result, outcomes=outcomes, checks=checks)


def left_in_box(result: TaskResult, box: Box) -> list[ObjectEstimate]:
    """Return what is in the box although it was not placed there, where it was seen last, by ascending id.

    It toppled when it was released, for instance, and could not be turned.

    Args:
        result: results of all rounds so far.
        box: the box.
    """
    by_id = {estimate.id: estimate for estimate in result.objects}
    found: list[ObjectEstimate] = []
    for outcome in sorted(result.outcomes, key=lambda outcome: outcome.id):
        T_left = outcome.T_world_left
        if outcome.placed or T_left is None or not box.contains(T_left) or outcome.id not in by_id:
            continue
        assert result.plan is not None
        before = by_id[outcome.id]
        T = expected_pose(before, result.plan, replace(outcome, T_world_stand=T_left))
        found.append(_resting(before, T, ()))
    return found


def is_something_lost(result: TaskResult) -> bool:
    """Return whether an object is neither in its place nor was found anywhere."""
    return any(_is_lost(outcome) for outcome in result.outcomes)


def with_lost_found(result: TaskResult, frames: Sequence[RgbdFrame], box: Box) -> TaskResult:
    """Return the results with the places of what was lost above the box and lies in it.

    While it was looked for, others that it had knocked over may not have been where they were expected.

    Args:
        result: results of all rounds so far.
        frames: images of the box.
        box: the box.
    """
    assert result.plan is not None
    by_id = {estimate.id: estimate for estimate in result.objects}
    scene = SearchScene(frames, box_interior(box), list(placed_estimates(result).values()))
    outcomes = list(result.outcomes)
    for number, outcome in enumerate(outcomes):
        if not _is_lost(outcome) or outcome.id not in by_id:
            continue
        estimate = by_id[outcome.id]
        check = relocate(estimate, scene)
        if check is not None and check.inlier_share >= AGREES:
            T_left = stand_pose(estimate, result.plan, check.T_world_object)
            outcomes[number] = replace(outcome, T_world_left=T_left)
    return replace(result, outcomes=outcomes)


def items_left(result: TaskResult, left: Sequence[ObjectEstimate]) -> dict[str, StandingObject]:
    """Return what ``left_in_box`` returns as it is there, by name."""
    assert result.plan is not None
    T_left = {outcome.id: outcome.T_world_left for outcome in result.outcomes}
    return {
        estimate.name: replace(result.plan.objects[estimate.name], T_world_stand=T)
        for estimate in left
        if (T := T_left[estimate.id]) is not None
    }


def _is_lost(outcome: ObjectOutcome) -> bool:
    return not outcome.placed and outcome.T_world_left is None


def _out_of_line(mugs: Mapping[int, ObjectEstimate], checks: Mapping[int, PoseCheck]) -> list[int]:
    """Return the ids of mugs whose handles are not in line, those turned most.

    Each may be turned a little, and two of them to different sides.
    """
    turns = {id: turn_between(mug.T_world_object, checks[id].T_world_object) for id, mug in mugs.items()}
    found = [id for id, turn in turns.items() if abs(turn) > TURNED]
    rest = {id: turn for id, turn in turns.items() if id not in found}
    while rest and max(rest.values()) - min(rest.values()) > APART:
        most = max(rest, key=lambda id: abs(rest[id]))
        found.append(most)
        del rest[most]
    return found


def _is_doubtful(check: PoseCheck) -> bool:
    """Return whether an object may not stand where it was placed; what is hidden is believed to."""
    if check.status != "seen":
        return check.status == "not_there"
    return bool(check.tilt > LEANING or check.inlier_share < AGREES)


def _resting(
    estimate: ObjectEstimate, T: Float[np.ndarray, "4 4"], others: Sequence[ObjectEstimate]
) -> ObjectEstimate:
    """Return an estimate at a pose in the box; what leans rests on the nearest other object."""
    if lies(T):
        resting: RestingPose = "upside-down" if is_upside_down(T) else "lying"
        return replace(estimate, T_world_object=T, resting=resting, rests_on=None)
    nearest = min(others, key=lambda o: float(np.linalg.norm((o.T_world_object - T)[:2, 3])), default=None)
    rests_on = None if nearest is None else nearest.id
    return replace(estimate, T_world_object=T, resting="upright", rests_on=rests_on)
