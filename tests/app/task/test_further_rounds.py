"""Rounds after the first, with each stage replaced by one that records its arguments."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.pipeline import run
from app.task.stages import FULL_SCAN
from app.task.task_types import TaskRequest
from manipulation.errors import PlanningError
from manipulation.planner import ManipulationConfig
from manipulation.standing import to_standing
from manipulation.types import Box, Line, ObjectOutcome
from manipulation.workspace import Workspace
from perception.errors import PerceptionError
from perception.geometry import pose_from_yaw
from perception.pipeline import Detections
from perception.types import RejectedObject, SupportPlane, unclassified
from tests.app.task.conftest import SEEN, Recording, StillRobot


def test_what_is_left_on_the_table_is_looked_at_and_packed_in_another_round(stages, can_at):
    """The second can had no goal; in the second scan it stands free and is found anew."""
    second = ObjectOutcome(2, "can_2", True, 1, "", pose_from_yaw(0.0, np.array([0.6, 0.3, 0.004])))
    results = iter([stages.objects, [can_at(0, 0.5), can_at(1, 0.5, 0.27)]])  # and the one in the box
    outcomes = iter([stages.outcomes, [second]])
    executed = []

    def execute(plan, *args, **options):
        executed.append(plan)
        return next(outcomes)

    stages.replace("reconstruct_objects", lambda *args, **options: next(results))
    stages.replace("execute", execute)
    observer = Recording()
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=2), observer)
    assert result.failure == "" and len(executed) == 2
    assert [estimate.id for estimate in result.objects] == [0, 2]
    assert [(o.name, o.placed) for o in result.outcomes] == [("can_0", True), ("can_2", True)]
    assert [p.name for p in result.plan.placements] == ["can_0", "can_2"] and result.plan.left_out == {}
    # The plan of the second round has what is in the box where it is now, and a goal for the rest alone.
    assert [p.name for p in executed[1].placements] == ["can_2"]
    assert executed[1].objects["can_0"].T_world_stand[:2, 3] == pytest.approx((0.5, 0.27))
    assert set(result.checks) == {0, 2}
    assert stages.scanner.visited[1] == Workspace().scan_viewpoints(FULL_SCAN)
    assert observer.calls.count("execute") == 2 and ("objects", [0, 2]) in observer.calls


def test_what_is_left_after_sorting_is_sorted_in_another_round(stages, can_at, pack_plan):
    """Beside the rows: what stands on them is known, and is neither detected nor reconstructed again."""
    at = np.array([*Line().start, 0.0])
    outcomes = iter(
        [
            [ObjectOutcome(0, "can_0", True, 1, "", pose_from_yaw(0.0, at))],
            [ObjectOutcome(2, "can_2", True, 1, "", pose_from_yaw(0.0, np.array([0.5, 0.25, 0.0])))],
        ]
    )
    results = iter([stages.objects, [can_at(0, 0.5), can_at(1, *at[:2] + 0.01)]])
    executed, known = [], []

    def execute(plan, *args, **options):
        executed.append(plan)
        return next(outcomes)

    def beside_box(bounds, frames, found):
        known.append(bounds)
        return found

    plan = replace(pack_plan, task="sort", box=None, lines=(Line(),))
    stages.replace("plan_sort", lambda *args: plan)
    stages.replace("reconstruct_objects", lambda *args, **options: next(results))
    stages.replace("execute", execute)
    stages.replace("beside_box", beside_box)
    result = run(StillRobot(), stages.perception, TaskRequest("sort", rounds=2))
    assert result.failure == "" and len(executed) == 2
    assert [(o.name, o.placed) for o in result.outcomes] == [("can_0", True), ("can_2", True)]
    assert executed[1].task == "sort" and [p.name for p in executed[1].placements] == ["can_2"]
    assert executed[1].objects["can_0"].T_world_stand[:2, 3] == pytest.approx(at[:2])
    assert result.plan.lines == (Line(),)
    assert len(known[0]) == 0 and len(known[1]) == 1, "what stands on the row"
    assert (known[1][0][0][:2] < at[:2]).all() and (known[1][0][1][:2] > at[:2]).all()


def test_what_could_not_be_placed_is_looked_at_from_nearby_before_another_round(stages):
    """Its top may be beyond the border of every image of the scan: where it stands now, it was set aside."""
    left = pose_from_yaw(0.0, np.array([0.3, 0.02, 0.0]))
    failed = ObjectOutcome(0, "can_0", False, 2, "something unknown is in the way", T_world_left=left)
    given = []

    def with_judged(detections, frames, before, unplaced, n_scanned):
        given.append((len(frames), n_scanned))
        return detections

    nothing = lambda frames, *args, **options: Detections(SupportPlane(), ((),) * len(frames))  # noqa: E731
    stages.replace("detect", nothing)
    stages.replace("with_judged", with_judged)
    stages.replace("execute", lambda *args, **options: [failed])
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=2))
    assert stages.scanner.visited[1] == Workspace().scan_viewpoints(FULL_SCAN)
    assert stages.scanner.visited[2] == Workspace().closeup_viewpoints(0.3, 0.02)
    assert given == [(2, 1)], "the closer image has no counterpart in the round before"


@pytest.mark.parametrize(("rounds", "first"), [(1, ["can_0"]), (2, [])])
def test_what_carries_an_object_has_a_goal_in_the_last_round_alone(stages, pack_plan, rounds, first):
    lower, upper = stages.objects
    upper = replace(upper, rests_on=lower.id)
    (goal,) = pack_plan.placements
    plan = replace(pack_plan, placements=(goal, replace(goal, name=upper.name)))
    executed = []
    stages.replace("reconstruct_objects", lambda *args, **options: [lower, upper])
    stages.replace("plan_pack", lambda *args: plan)
    stages.replace("execute", lambda plan, *args, **options: executed.append(plan) or [])
    run(StillRobot(), stages.perception, TaskRequest("pack", rounds=rounds))
    assert [p.name for p in executed[0].placements] == [*first, "can_1"]


def test_after_a_round_that_moved_nothing_nothing_waits(stages, pack_plan):
    lower, upper = stages.objects
    (goal,) = pack_plan.placements
    plan = replace(pack_plan, placements=(goal, replace(goal, name=upper.name)), left_out={})
    further = [replace(p, name=name) for p, name in zip(plan.placements, ("can_2", "can_3"), strict=True)]
    executed = []
    stacked = [lower, replace(upper, rests_on=lower.id)]
    stages.replace("reconstruct_objects", lambda *args, **options: stacked)
    stages.replace("plan_pack", lambda *args: plan)
    items = dict(zip(("can_2", "can_3"), plan.objects.values(), strict=True))
    second = replace(plan, objects=items, placements=tuple(further))
    stages.replace("plan_further", lambda *args: second)
    stages.replace("execute", lambda plan, *args, **options: executed.append(plan) or [])
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=4))
    assert [[p.name for p in plan.placements] for plan in executed] == [["can_1"], ["can_2", "can_3"]]


@pytest.mark.parametrize("error", [PerceptionError("no plane"), PlanningError("none can be manipulated")])
def test_a_further_round_that_fails_keeps_the_results(stages, error):
    stages.stage("plan_further", error)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and result.outcomes == stages.outcomes and result.checks == {0: SEEN}
    assert len(stages.scanner.visited) == 3, "two scans and the verification"


def test_a_part_of_a_thing_is_not_fitted_again_in_further_rounds(stages):
    """Each round compares with what the one before saw, the first included, and reports the part again."""
    part = RejectedObject(4, "mug", "it goes on", 0.9, is_part=True)
    mask = np.ones(stages.scanner.frame.depth.shape, bool)
    detections = Detections(SupportPlane(), ((unclassified(mask, 3), unclassified(mask, 4)),))
    compared, fitted = [], []
    stages.stage("detect", detections)
    stages.replace("with_judged", lambda detections, *args: detections)
    stages.replace("parts_as_before", lambda found, frames, before, n: compared.append(before) or [part])

    def reconstruct(frames, detections, *args, **options):
        fitted.append([d.instance_id for d in detections.per_frame[0]])
        return stages.objects

    stages.replace("reconstruct_objects", reconstruct)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=3))
    assert fitted == [[3, 4], [3, None], [3, None]]
    assert [list(before.rejected) for before in compared] == [[], [part]]
    masks = [[d.instance_id for d in before.detections.per_frame[0]] for before in compared]
    assert masks == [[3, 4], [3, 4]], "the part has its masks, where the next round looks for it"
    assert [len(before.objects) for before in compared] == 2 * [len(stages.objects)], "known beside it"
    assert stages.scanner.as_before[:2] == [True, True], "the images of two rounds are compared"
    assert list(result.rejected) == [part]


def test_what_was_left_in_the_box_is_tried_once_more_and_then_stays_there(stages, pack_plan):
    lying = replace(stages.objects[1], T_world_object=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.03])))
    planned, executed = [], []

    def plan_further(objects, placed, *args):
        planned.append(([e for e in objects if e is lying], "can_1" in placed))
        return pack_plan

    def execute(plan, *args, **options):
        executed.append(plan)
        return stages.outcomes

    stages.replace("left_in_box", lambda result, box: [lying])
    stages.replace("items_left", lambda result, left: {e.name: to_standing(stages.objects[1]) for e in left})
    stages.replace("plan_further", plan_further)
    stages.replace("execute", execute)
    stages.replace("is_something_left", lambda *args: len(executed) < 3)
    run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert planned[:2] == [([lying], False), ([], True)]


def test_what_was_lost_is_looked_for_in_the_box_before_another_round(stages):
    """It may have slipped from the hand above it."""
    searched = []
    lost = ObjectOutcome(0, "can_0", False, 1, "lost during the transfer")
    stages.replace("execute", lambda *args, **options: [lost])
    stages.replace("with_lost_found", lambda result, frames, box: searched.append(len(frames)) or result)
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=2))
    assert stages.scanner.visited[1] == Workspace().box_viewpoints and searched == [1]


def test_what_fell_in_the_box_is_placed_again_and_verified_again(stages, pack_plan):
    lying = replace(stages.objects[0], T_world_object=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.03])))
    results, executed, plans = iter([[lying], []]), [], []
    again = replace(stages.outcomes[0], attempts=2)

    def execute(plan, *args, **options):
        executed.append(plan)
        return stages.outcomes if len(executed) == 1 else [again]

    def plan_further(objects, placed, box, *args):
        plans.append((objects, dict(placed)))
        name = objects[0].name
        item = replace(first.objects[name], T_world_stand=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.0])))
        return replace(first, objects={name: item}, left_out={})

    first = pack_plan
    stages.replace("fallen_objects", lambda *args: next(results))
    stages.replace("execute", execute)
    stages.replace("plan_further", plan_further)
    stages.replace("is_something_left", lambda *args: False)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == 2
    ((objects, placed),) = plans
    assert objects == [lying] and placed == {}, "it is no longer among what stands in the box"
    assert [o.attempts for o in result.outcomes] == [2]
    (first,) = (e for e in result.objects if e.id == 0)
    np.testing.assert_allclose(first.T_world_object, stages.objects[0].T_world_object, atol=1e-9)
    assert len(stages.scanner.visited) == 3, "one scan and two verifications"


def test_what_is_not_in_the_box_any_more_is_looked_for_on_the_table(stages):
    def without_gone(result, box):
        outcomes = [replace(outcome, placed=False, T_world_stand=None) for outcome in result.outcomes]
        return replace(result, outcomes=outcomes) if result.outcomes[0].placed else result

    looked = []
    stages.replace("without_gone", without_gone)
    stages.replace("fallen_objects", lambda placed, *args: [])
    stages.replace("loose_bowl", lambda *args: None)
    stages.replace("with_bowls_named", lambda result, *args: result)
    stages.replace("is_something_left", lambda result, latest: looked.append(result.outcomes) and False)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and [o.placed for o in result.outcomes] == [False]
    assert [[o.placed for o in outcomes] for outcomes in looked] == [[True], [False]]


def test_a_bowl_beside_the_one_that_it_fits_into_is_placed_again_once(stages, pack_plan):
    loose = to_standing(stages.objects[0])
    again = replace(stages.outcomes[0], attempts=2)
    executed, named = [], []
    stages.replace("fallen_objects", lambda *args: [])
    stages.replace("loose_bowl", lambda *args: loose)
    stages.replace("with_bowls_named", lambda result, *args: named.append(result) or result)

    def execute(plan, *args, **options):
        executed.append(plan)
        return stages.outcomes if len(executed) == 1 else [again]

    stages.replace("execute", execute)
    stages.replace("plan_further", lambda found, *args: pack_plan)
    stages.replace("is_something_left", lambda *args: False)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == 2 and len(named) == 2
    assert [o.attempts for o in result.outcomes] == [2]


@pytest.mark.parametrize(("unplaced", "rounds"), [(True, 3), (False, 2)])
def test_once_something_was_placed_again_there_may_be_room(stages, pack_plan, unplaced, rounds):
    loose, executed = to_standing(stages.objects[0]), []
    stages.replace("fallen_objects", lambda *args: [])
    stages.replace("loose_bowl", lambda *args: loose)
    stages.replace("with_bowls_named", lambda result, *args: result)
    stages.replace("execute", lambda plan, *args, **options: executed.append(plan) or stages.outcomes)
    stages.replace("plan_further", lambda found, *args: pack_plan)
    stages.replace("is_something_left", lambda *args: len(executed) == 2)
    stages.replace("is_something_unplaced", lambda result: unplaced)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == rounds


def test_what_cannot_be_placed_again_ends_the_task_as_it_is(stages):
    stages.replace("fallen_objects", lambda *args: [stages.objects[0]])
    stages.replace("is_something_left", lambda *args: False)
    stages.stage("plan_further", PlanningError("no room"))
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and result.outcomes == stages.outcomes and result.checks == {0: SEEN}


@pytest.fixture
def sorted_cans(stages, can_at, pack_plan):
    """A task that sorts two cans, of which the higher one, which lay, turns out to be the lower one."""
    plan = replace(pack_plan, task="sort", box=None, lines=(Line(),), left_out={})
    (goal,) = plan.placements
    plan = replace(plan, placements=(goal, replace(goal, name="can_1")))
    at = [np.array([*np.array(Line().start) + x * Line().direction, 0.0]) for x in (0.2, 0.4)]
    outcomes = [ObjectOutcome(id, f"can_{id}", True, 1, "", pose_from_yaw(0.0, at[id])) for id in range(2)]
    executed, measured = [], []

    def execute(plan, *args, **options):
        executed.append(plan)
        return outcomes if len(executed) == 1 else [replace(outcomes[1], attempts=2)]

    def with_sizes_measured(result, ids, perception, look):
        measured.append(set(ids))
        items = dict(result.plan.objects)
        items["can_1"] = replace(items["can_1"], size=items["can_0"].size - 0.02)
        return replace(result, plan=replace(result.plan, objects=items))

    stages.replace("reconstruct_objects", lambda *args, **options: [can_at(0), lying(can_at(1, 0.5))])
    stages.replace("plan_sort", lambda *args: plan)
    stages.replace("execute", execute)
    stages.replace("with_sizes_measured", with_sizes_measured)
    stages.replace("is_something_left", lambda *args: False)
    stages.replace("out_of_order", lambda placed, lines: {"can_1"})
    stages.measured, stages.executed = measured, executed
    return stages


def lying(estimate):
    return replace(estimate, resting="lying")


def test_what_is_out_of_order_on_the_rows_is_placed_again_once(sorted_cans):
    given = []

    def plan_further_sort(objects, placed, lines, *args):
        given.append((objects, set(placed), lines))
        return replace(sorted_cans.executed[0], placements=sorted_cans.executed[0].placements[1:])

    sorted_cans.replace("plan_further_sort", plan_further_sort)
    result = run(StillRobot(), sorted_cans.perception, TaskRequest("sort"))
    assert result.failure == "" and sorted_cans.measured == [{1}]
    (((moved,), others, lines),) = given
    assert (moved.name, moved.resting, others, lines) == ("can_1", "upright", {"can_0"}, (Line(),))
    np.testing.assert_allclose(moved.T_world_object[:2, 3], Line().start + 0.4 * Line().direction, atol=1e-9)
    assert [[p.name for p in plan.placements] for plan in sorted_cans.executed] == [
        ["can_0", "can_1"],
        ["can_1"],
    ]
    assert {o.name: o.attempts for o in result.outcomes} == {"can_0": 1, "can_1": 2}
    assert [e.resting for e in result.objects] == ["upright", "lying"], "as it was found"


def test_what_has_no_place_in_the_order_stays(sorted_cans):
    sorted_cans.stage("plan_further_sort", PlanningError("no room"))
    result = run(StillRobot(), sorted_cans.perception, TaskRequest("sort"))
    assert result.failure == "" and len(sorted_cans.executed) == 1
    assert [o.placed for o in result.outcomes] == [True, True]


def test_true_shapes_are_not_measured(sorted_cans, can_at):
    shapes = lambda frames, detections: [can_at(0), lying(can_at(1, 0.5))]  # noqa: E731
    run(StillRobot(), sorted_cans.perception, TaskRequest("sort", reconstruction=shapes))
    assert sorted_cans.measured == [] and len(sorted_cans.executed) == 1


@pytest.mark.parametrize(
    ("hides", "uncertainty", "scans"), [(True, True, 2), (False, True, 1), (True, False, 1)]
)
def test_what_the_scan_may_have_hidden_is_looked_for_once_when_all_is_done(
    stages, pack_plan, hides, uncertainty, scans
):
    """With as many images as the scan; the second look finds nothing."""
    asked = []

    def may_hide(frames, objects, area, plane):
        asked.append(([estimate.id for estimate in objects], area))
        return hides

    stages.replace("may_hide_an_object", may_hide)
    stages.replace("plan_pack", lambda *args: replace(pack_plan, left_out={}))
    results = iter([[estimate for estimate in stages.objects if estimate.id == 0], []])
    stages.replace("reconstruct_objects", lambda *args, **options: next(results))
    request = TaskRequest("pack", Box(), rounds=3, scan_views=1, uncertainty=uncertainty)
    result = run(StillRobot(), stages.perception, request)
    assert result.failure == "" and [outcome.placed for outcome in result.outcomes] == [True]
    seen = [views for views in stages.scanner.visited if views == Workspace().scan_viewpoints(1)]
    assert len(seen) == scans
    assert len(asked) == (1 if uncertainty else 0)
    assert not asked or asked[0] == ([0], ManipulationConfig().free_area)
