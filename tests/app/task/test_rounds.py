"""Results of several rounds: what is left, what is where, and what replaces what."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.rounds import (
    COVERED,
    NOT_FOUND_AGAIN,
    as_first_seen,
    expected_pose,
    has_changed,
    is_something_left,
    is_something_unplaced,
    placed_estimates,
    placed_items,
    places_of_left,
    renumbered,
    stand_pose,
    unplaced_estimates,
    with_round,
    without_covered,
)
from app.task.task_types import TaskResult
from manipulation.types import Box, ObjectOutcome
from perception.geometry import pose_from_yaw
from perception.types import RejectedObject

REST = pose_from_yaw(np.pi / 2, np.array([0.5, 0.27, 0.004]))


@pytest.fixture
def result(can_at, pack_plan) -> TaskResult:
    """One can was placed, the other one had no goal."""
    outcome = ObjectOutcome(0, "can_0", True, 1, "", REST)
    return TaskResult(objects=[can_at(0), can_at(1, 0.5)], plan=pack_plan, outcomes=[outcome])


def test_the_expected_pose_is_that_of_the_object_carried_with_its_stand_frame(can_at, pack_plan):
    outcome = ObjectOutcome(0, "can_0", True, 1, "", REST)
    T_before = can_at().T_world_object  # centre of the can, 50 mm above the table
    stand = pack_plan.objects["can_0"].T_world_stand
    T = expected_pose(can_at(), pack_plan, outcome)
    np.testing.assert_allclose(T[:3, 3], (0.5, 0.27, 0.054), atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(REST) @ T, np.linalg.inv(stand) @ T_before, atol=1e-9)
    np.testing.assert_allclose(stand_pose(can_at(), pack_plan, T), REST, atol=1e-9)


def test_a_round_follows_what_left_something_and_changed_the_table(result, pack_plan):
    all_placed, done = replace(result, plan=replace(pack_plan, left_out={})), result.outcomes
    assert is_something_left(result, done), "an object without a goal"
    assert not is_something_left(all_placed, done)
    assert is_something_left(replace(all_placed, rejected=[RejectedObject(7, "mug", "small")]), done)
    (outcome,) = done
    failed = replace(outcome, placed=False)
    assert is_something_left(replace(all_placed, outcomes=[failed]), [failed])
    assert not is_something_left(result, [replace(failed, attempts=0)]), "nothing was moved"
    assert not is_something_left(result, []), "in the last round"


def test_the_places_of_what_was_left_on_the_table():
    def left(number, T=None, placed=False):
        return ObjectOutcome(number, f"can_{number}", placed, 1, "", T_world_left=T)

    box, on_table, in_box = Box(), pose_from_yaw(0.3, np.array([0.4, -0.2, 0.0])), REST
    outcomes = [left(0, on_table), left(1, in_box), left(2), left(3, on_table, placed=True)]
    assert places_of_left(outcomes, box) == [(0.4, -0.2)]
    assert places_of_left(outcomes, None) == [(0.4, -0.2), (0.5, 0.27)]


def test_what_has_no_goal_or_is_not_there_is_unplaced(result):
    assert is_something_unplaced(result), "the other can has no goal"
    all_placed = replace(result, plan=replace(result.plan, left_out={}))
    assert not is_something_unplaced(all_placed)
    failed = replace(result.outcomes[0], placed=False)
    assert is_something_unplaced(replace(all_placed, outcomes=[failed]))


def test_placed_objects_are_where_they_were_placed(result):
    assert list(placed_items(result)) == ["can_0"] and list(placed_estimates(result)) == [0]
    np.testing.assert_array_equal(placed_items(result)["can_0"].T_world_stand, REST)
    assert placed_estimates(result)[0].T_world_object[:3, 3] == pytest.approx((0.5, 0.27, 0.054))


def test_what_was_not_placed_is_where_it_was_found(result):
    (left,) = unplaced_estimates(result)
    assert left is result.objects[1]
    assert unplaced_estimates(replace(result, outcomes=[])) == result.objects


def test_new_estimates_get_new_ids_and_keep_what_rests_on_what(result, can_at):
    stacked = [can_at(0, 0.4), replace(can_at(1, 0.4), rests_on=0), can_at(2, *Box().center)]
    found = renumbered(stacked, result.objects, Box())
    assert [(estimate.id, estimate.rests_on) for estimate in found] == [(2, None), (3, 2)], "not in the box"
    assert len(renumbered(stacked, [], None)) == 3
    assert [e.id for e in renumbered(stacked, [], None, [can_at(7, 0.41)])] == [2], "not what is on a row"


def test_what_was_not_placed_is_replaced_by_what_is_found_in_its_place(result, can_at, pack_plan):
    beside = can_at(2, 0.5 + 0.02)
    items = {"can_2": replace(pack_plan.objects["can_1"], id=2)}
    goals = (replace(pack_plan.placements[0], name="can_2"),)
    plan = replace(pack_plan, objects=items, placements=goals, left_out={})
    outcome = ObjectOutcome(2, "can_2", True, 1, "", REST)
    merged = with_round(result, [beside], plan, [outcome], ())
    assert [estimate.id for estimate in merged.objects] == [0, 2]
    assert [p.name for p in merged.plan.placements] == ["can_0", "can_2"]
    assert merged.plan.left_out == {} and [o.name for o in merged.outcomes] == ["can_0", "can_2"]
    # At the pose of the first scan, to which its estimate belongs.
    np.testing.assert_array_equal(
        merged.plan.objects["can_0"].T_world_stand, pack_plan.objects["can_0"].T_world_stand
    )
    far = with_round(result, [can_at(2, 0.8)], plan, [outcome], ())
    assert [estimate.id for estimate in far.objects] == [0, 1, 2] and far.plan.left_out == {
        "can_1": "too far"
    }


def test_what_waited_and_was_not_found_again_waits_no_longer(result, can_at, pack_plan):
    waited = replace(result, plan=replace(pack_plan, left_out={"can_1": COVERED, "can_9": COVERED}))
    plan = replace(pack_plan, objects={}, placements=(), left_out={"can_2": COVERED})
    merged = with_round(waited, [can_at(2, 0.8)], plan, [], ())
    assert merged.plan.left_out == {"can_1": NOT_FOUND_AGAIN, "can_2": COVERED}


@pytest.mark.parametrize("attempts", [0, 1])
def test_what_is_moved_in_the_box_has_its_latest_outcome_unless_it_was_never_touched(
    result, pack_plan, attempts
):
    (before,) = result.outcomes
    failed = replace(before, placed=False, attempts=attempts, reason="no plan", T_world_stand=None)
    merged = with_round(result, [], pack_plan, [failed], ())
    assert list(merged.outcomes) == [before if attempts == 0 else failed]
    assert [p.name for p in merged.plan.placements].count("can_0") == 1


def test_what_carries_others_waits_for_the_next_round_and_so_do_bowls_that_go_into_it(can_at, pack_plan):
    """0 carries 1, which is packed; 2 goes into 0; 3 carries 4, which cannot be packed."""
    objects = [replace(can_at(i), rests_on={1: 0, 4: 3}.get(i)) for i in range(5)]
    (goal,) = pack_plan.placements
    goals = [replace(goal, name=f"can_{i}", stack=("can_0",) if i == 2 else ()) for i in range(4)]
    plan = replace(pack_plan, placements=tuple(goals), left_out={"can_4": "too far"})
    waiting = without_covered(plan, objects)
    assert [p.name for p in waiting.placements] == ["can_1", "can_3"]
    assert waiting.left_out == {"can_4": "too far", "can_0": COVERED, "can_2": COVERED}
    assert waiting.objects is plan.objects, "they are in the way of others"
    free = [replace(estimate, rests_on=None) for estimate in objects]
    assert without_covered(plan, free).placements == plan.placements


def test_a_bowl_in_the_one_that_it_goes_into_does_not_keep_it_waiting(can_at, pack_plan):
    """Else both would wait for each other, in every round: 1 is in 0, and goes into 0."""
    objects = [can_at(0), replace(can_at(1), rests_on=0)]
    (goal,) = pack_plan.placements
    plan = replace(pack_plan, placements=(goal, replace(goal, name="can_1", stack=("can_0",))), left_out={})
    assert without_covered(plan, objects) == plan
    above = [*objects, replace(can_at(2), rests_on=1)]  # but what covers it as well does
    plan = replace(plan, placements=(*plan.placements, replace(goal, name="can_2")))
    waiting = without_covered(plan, above)
    assert [p.name for p in waiting.placements] == ["can_0", "can_2"] and list(waiting.left_out) == ["can_1"]


def test_what_was_placed_again_is_in_the_map_where_it_was_on_the_table(result, can_at):
    """It was found upside down in the box, and stands at its goal now."""
    T = pose_from_yaw(0.4, np.array([0.45, 0.3, 0.05])) @ np.diag([1.0, -1.0, -1.0, 1.0])
    found = replace(can_at(0), T_world_object=T)
    item = replace(
        result.plan.objects["can_0"], T_world_stand=T @ pose_from_yaw(0.0, np.array([0, 0, -0.05]))
    )
    plan = replace(result.plan, objects={**result.plan.objects, "can_0": item})
    again = replace(result, objects=[found, result.objects[1]], plan=plan)
    kept = as_first_seen(again, result)
    for estimate, first in zip(kept.objects, result.objects, strict=True):
        np.testing.assert_allclose(estimate.T_world_object, first.T_world_object, atol=1e-9)
    expected, found_at = placed_estimates(kept)[0].T_world_object, placed_estimates(again)[0].T_world_object
    np.testing.assert_allclose(expected, found_at, atol=1e-9, err_msg="where it is now is as before")


def test_what_waits_is_looked_at_again(result, can_at):
    above = replace(can_at(1, 0.5), rests_on=0)
    plan = replace(result.plan, left_out={})
    both = replace(plan, placements=(*plan.placements, replace(plan.placements[0], name="can_1")))
    waiting = without_covered(both, [can_at(0), above])
    assert is_something_left(replace(result, plan=waiting), result.outcomes)
    assert is_something_left(replace(result, plan=waiting), []), "although nothing was moved"
    assert has_changed(result.outcomes) and not has_changed([replace(result.outcomes[0], attempts=0)])
