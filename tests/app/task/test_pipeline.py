"""Order and data flow of the stages, with each stage replaced by one that records its arguments."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import app.task.pipeline as pipeline
from app.task.pipeline import FULL_SCAN, run, verify
from app.task.run_observer import RunObserver
from app.task.task_types import TaskRequest
from manipulation.errors import PlanningError
from manipulation.planner import ManipulationConfig
from manipulation.robot import RobotState
from manipulation.standing import to_standing
from manipulation.types import Box, Line, ObjectOutcome
from manipulation.viewpoints import (
    BOX_VIEWPOINTS,
    LINE_VIEWPOINTS,
    SCAN_VIEWPOINTS,
    ViewpointScanner,
)
from manipulation.workspace import Workspace
from perception.errors import PerceptionError
from perception.geometry import pose_from_yaw
from perception.inference.refit import PoseCheck
from perception.pipeline import Detections, Perception
from perception.types import RejectedObject, SupportPlane
from sim_assets.robots import panda


class StillRobot:
    arm = panda().description

    def state(self):
        return RobotState(0.0, self.joint_positions(), self.gripper_width())

    def stop(self, reason):
        raise AssertionError(reason)

    def joint_positions(self):
        return self.arm.q_home

    def gripper_width(self):
        return 0.08

    def follow(self, trajectory):
        pass

    def move_gripper(self, width):
        return width

    def capture(self):
        raise NotImplementedError


class Scanner(ViewpointScanner):
    """Returns one image per call; records the viewpoints."""

    def __init__(self, frame):
        self.frame, self.visited, self.error = frame, [], None

    def capture(self, viewpoints, progress=None, on_frame=None):
        self.visited.append(tuple(viewpoints))
        if self.error is not None:
            raise self.error
        if on_frame is not None:
            on_frame(self.frame)
        return [self.frame]


class Recording(RunObserver):
    def __init__(self):
        super().__init__()
        self.calls = []

    def stage(self, name):
        self.calls.append(name)
        return super().stage(name)

    def on_image(self, frame):
        self.calls.append("image")

    def on_frames(self, frames):
        self.calls.append(("frames", len(frames)))

    def on_detections(self, detections):
        self.calls.append(detections)

    def on_objects(self, objects):
        self.calls.append(("objects", [estimate.id for estimate in objects]))

    def on_plan(self, plan):
        self.calls.append(plan)


SEEN = PoseCheck(np.eye(4), "seen", 0.9, 500, 0.01, 0.02)
FOUND = Detections(SupportPlane(), ((),))


class FakeDetector:
    def complete(self, frame, plane, detections):
        return list(detections)


DETECTOR = FakeDetector()


@pytest.fixture
def stages(monkeypatch, overhead_frame, can_at, pack_plan):
    """The replaced stages, and what they were called with."""
    scanner, calls = Scanner(overhead_frame), {}
    objects = [can_at(0), can_at(1, 0.5)]
    outcomes = [ObjectOutcome(0, "can_0", True, 1, "", pose_from_yaw(0.0, np.array([0.5, 0.27, 0.004])))]

    def stage(name, result):
        def call(*args, **options):
            calls[name] = (*args, *options.items())
            if isinstance(result, Exception):
                raise result
            return result

        monkeypatch.setattr(pipeline, name, call)

    monkeypatch.setattr(pipeline, "ViewpointScanner", lambda robot, kinematics, **settings: scanner)
    stage("detect", FOUND)
    stage("reconstruct_objects", objects)
    stage("plan_pack", pack_plan)
    stage("plan_sort", pack_plan)
    stage("execute", outcomes)
    stage("refit_pose", SEEN)
    monkeypatch.setattr(pipeline, "with_bowls_named", lambda result, *args: result)
    perception = object.__new__(Perception)
    object.__setattr__(perception, "detector", DETECTOR)
    object.__setattr__(perception, "decoder", "decoder")
    return SimpleNamespace(
        scanner=scanner, calls=calls, objects=objects, outcomes=outcomes, perception=perception, stage=stage
    )


def test_objects_of_the_first_half_of_the_images_are_the_starts_of_the_fits(stages, monkeypatch):
    calls = []

    def reconstruct_objects(frames, detections, decoder, *args, **options):
        calls.append((len(frames), options.get("starts"), options.get("clutter")))
        return stages.objects

    monkeypatch.setattr(pipeline, "reconstruct_objects", reconstruct_objects)
    request = TaskRequest("pack", scan_views=2, perceive_only=True)
    run(StillRobot(), stages.perception, request)
    assert calls == [(1, None, None), (1, tuple(stages.objects), DETECTOR)]
    calls.clear()
    run(StillRobot(), stages.perception, TaskRequest("pack", scan_views=1, perceive_only=True))
    assert calls == [(1, (), DETECTOR)]


def test_other_sources_of_shapes_need_no_early_fits(stages, monkeypatch):
    monkeypatch.setattr(pipeline, "reconstruct_objects", lambda *args, **options: pytest.fail("fitted"))
    request = TaskRequest(
        "pack", reconstruction=lambda f, d: stages.objects, scan_views=2, perceive_only=True
    )
    assert run(StillRobot(), stages.perception, request).objects == stages.objects


def test_a_further_image_is_fused_with_those_before_while_objects_are_uncertain(stages, monkeypatch):
    answers, asked, offered = [2, None], [], []

    def choose(objects, rejected, viewpoints, arm, config):
        asked.append((len(viewpoints), [item.name for item in rejected]))
        offered.append(tuple(viewpoints))
        answer = answers.pop(0)
        return None if answer is None else viewpoints[answer]

    def reconstruct(frames, detections, decoder, progress, on_step, on_rejected, clutter, starts):
        on_rejected(RejectedObject(len(frames), "mug", "seen from one side"))
        return stages.objects

    monkeypatch.setattr(pipeline, "detect", lambda frames, *_, **__: empty(len(frames)))
    monkeypatch.setattr(pipeline, "most_useful_viewpoint", choose)
    monkeypatch.setattr(pipeline, "reconstruct_objects", reconstruct)
    observer = Recording()
    request = TaskRequest("pack", scan_views=1, perceive_only=True)
    result = run(StillRobot(), stages.perception, request, observer)
    assert len(result.frames) == 2 and stages.scanner.visited[1] == (offered[0][2],)
    assert set(offered[0]) - set(offered[1]) == {offered[0][2]}  # it is not offered again
    assert asked == [(5, ["mug_1"]), (4, ["mug_2"])] and [r.id for r in result.rejected] == [2]
    assert [c for c in observer.calls if isinstance(c, str) and c in result.timings] == [
        "scan", "detect", "reconstruct", "scan", "detect", "reconstruct",
    ]  # fmt: skip
    assert sum(isinstance(c, tuple) and c[0] == "objects" for c in observer.calls) == 1


def empty(n_frames):
    return Detections(SupportPlane(), ((),) * n_frames)


@pytest.mark.parametrize("error", [None, PlanningError("out of reach")])
def test_the_scan_is_complete_where_nothing_more_can_be_seen(stages, monkeypatch, error):
    def choose(objects, rejected, viewpoints, arm, config):
        stages.scanner.error = error
        return viewpoints[0]

    monkeypatch.setattr(pipeline, "detect", lambda frames, *_, **__: empty(len(frames)))
    monkeypatch.setattr(pipeline, "most_useful_viewpoint", choose)
    off = TaskRequest("pack", scan_views=1, perceive_only=True, uncertainty=False)
    assert len(run(StillRobot(), stages.perception, off).frames) == 1
    on = TaskRequest("pack", scan_views=1, perceive_only=True)
    assert len(run(StillRobot(), stages.perception, on).frames) == (6 if error is None else 1)


def test_without_uncertainty_the_plan_takes_shapes_as_exact(stages, can_at, monkeypatch):
    monkeypatch.setattr(pipeline, "most_useful_viewpoint", lambda *args: None)
    vague = replace(can_at(0), surface_sigma=np.full(len(can_at(0).mesh.vertices), 0.01))
    stages.stage("reconstruct_objects", [vague])
    for uncertainty in (True, False):
        request = TaskRequest("pack", uncertainty=uncertainty, rounds=1)
        assert run(StillRobot(), stages.perception, request).failure == ""
        (planned,) = stages.calls["plan_pack"][0]
        assert (planned.surface_sigma is not None) == uncertainty


def test_stages_run_in_order_on_the_results_of_those_before(stages, pack_plan):
    observer, box = Recording(), Box(floor=0.01)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", box, rounds=1), observer)
    assert result.failure == "" and list(result.timings) == [
        "scan", "detect", "reconstruct", "plan", "execute", "verify",
    ]  # fmt: skip
    assert observer.calls == [
        "scan", "image", ("frames", 1), "detect", FOUND, "reconstruct", ("objects", [0, 1]),
        "plan", pack_plan, "execute", "verify", "image",
    ]  # fmt: skip
    calls = stages.calls
    assert calls["detect"][:2] == (result.frames, DETECTOR)
    assert calls["detect"][-1] == ("max_surfaces", 1)  # the planner knows the table alone
    assert calls["reconstruct_objects"][:3] == (result.frames, FOUND, "decoder")
    assert calls["plan_pack"][:2] == (stages.objects, box) and "plan_sort" not in calls
    assert calls["execute"][0] == pack_plan
    assert stages.scanner.visited == [tuple(SCAN_VIEWPOINTS), tuple(BOX_VIEWPOINTS)]
    assert result.plan == pack_plan and result.outcomes == stages.outcomes and result.checks == {0: SEEN}


def test_a_scaled_cell_has_its_own_viewpoints_and_heights(stages):
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), workspace=Workspace(0.8), rounds=1))
    scan, box = stages.scanner.visited
    assert scan == Workspace(0.8).scan_viewpoints() and box == Workspace(0.8).box_viewpoints
    for call in ("plan_pack", "execute"):
        (settings,) = (a for a in stages.calls[call] if isinstance(a, ManipulationConfig))
        assert settings == Workspace(0.8).adapted(ManipulationConfig())


def test_sorting_plans_for_the_line_and_verifies_it(stages):
    line, box = Line(start=(0.6, 0.2)), Box()
    result = run(StillRobot(), stages.perception, TaskRequest("sort", box, line))
    assert result.failure == "" and "plan_pack" not in stages.calls
    assert stages.calls["plan_sort"][:2] == (stages.objects, line) and box in stages.calls["plan_sort"]
    assert stages.scanner.visited[-1] == tuple(LINE_VIEWPOINTS)


def test_perception_alone_ends_with_the_object_map(stages):
    result = run(StillRobot(), stages.perception, TaskRequest("pack", perceive_only=True))
    assert result.objects == stages.objects and result.plan is None and not result.failure
    assert "plan_pack" not in stages.calls and list(result.timings) == ["scan", "detect", "reconstruct"]


def test_another_reconstruction_replaces_the_shape_prior(stages, can_at):
    received = []

    def reconstruction(frames, detections):
        received.append(detections)
        return [can_at(0, 0.45)]

    result = run(
        StillRobot(), stages.perception, TaskRequest("pack", reconstruction=reconstruction, rounds=1)
    )
    assert received == [FOUND] and len(stages.calls["plan_pack"][0]) == 1
    assert "reconstruct_objects" not in stages.calls and result.objects[0].T_world_object[0, 3] == 0.45


def test_objects_that_are_left_out_are_in_the_result(stages, monkeypatch):
    def reconstruct(frames, detections, decoder, progress, on_step, on_rejected, clutter, starts):
        on_rejected(RejectedObject(7, "mug", "the fit failed"))
        return stages.objects

    monkeypatch.setattr(pipeline, "reconstruct_objects", reconstruct)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", rounds=1))
    assert [item.name for item in result.rejected] == ["mug_7"] and result.objects == stages.objects


@pytest.mark.parametrize("error", [PlanningError("box too small"), PerceptionError("box too small")])
def test_a_failed_stage_ends_the_task_and_keeps_the_results_before(stages, error):
    stages.stage("plan_pack", error)
    result = run(StillRobot(), stages.perception, TaskRequest("pack"))
    assert result.failure == "box too small" and result.objects == stages.objects
    assert result.plan is None and result.outcomes == () and "execute" not in stages.calls
    assert list(result.timings) == ["scan", "detect", "reconstruct", "plan"]


def test_other_exceptions_are_not_results(stages):
    stages.stage("detect", AttributeError("no such member"))
    with pytest.raises(AttributeError):
        run(StillRobot(), stages.perception, TaskRequest("pack"))


def test_what_is_left_on_the_table_is_looked_at_and_packed_in_another_round(stages, can_at, monkeypatch):
    """The second can had no goal; in the second scan it stands free and is found anew."""
    second = ObjectOutcome(2, "can_2", True, 1, "", pose_from_yaw(0.0, np.array([0.6, 0.3, 0.004])))
    results = iter([stages.objects, [can_at(0, 0.5), can_at(1, 0.5, 0.27)]])  # and the one in the box
    outcomes = iter([stages.outcomes, [second]])
    executed = []

    def execute(plan, *args):
        executed.append(plan)
        return next(outcomes)

    monkeypatch.setattr(pipeline, "reconstruct_objects", lambda *args, **options: next(results))
    monkeypatch.setattr(pipeline, "execute", execute)
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


@pytest.mark.parametrize(("rounds", "first"), [(1, ["can_0"]), (2, [])])
def test_what_carries_an_object_has_a_goal_in_the_last_round_alone(
    stages, pack_plan, monkeypatch, rounds, first
):
    lower, upper = stages.objects
    upper = replace(upper, rests_on=lower.id)
    (goal,) = pack_plan.placements
    plan = replace(pack_plan, placements=(goal, replace(goal, name=upper.name)))
    executed = []
    monkeypatch.setattr(pipeline, "reconstruct_objects", lambda *args, **options: [lower, upper])
    monkeypatch.setattr(pipeline, "plan_pack", lambda *args: plan)
    monkeypatch.setattr(pipeline, "execute", lambda plan, *args: executed.append(plan) or [])
    run(StillRobot(), stages.perception, TaskRequest("pack", rounds=rounds))
    assert [p.name for p in executed[0].placements] == [*first, "can_1"]


def test_after_a_round_that_moved_nothing_nothing_waits(stages, pack_plan, monkeypatch):
    lower, upper = stages.objects
    (goal,) = pack_plan.placements
    plan = replace(pack_plan, placements=(goal, replace(goal, name=upper.name)), left_out={})
    further = [replace(p, name=name) for p, name in zip(plan.placements, ("can_2", "can_3"), strict=True)]
    executed = []
    stacked = [lower, replace(upper, rests_on=lower.id)]
    monkeypatch.setattr(pipeline, "reconstruct_objects", lambda *args, **options: stacked)
    monkeypatch.setattr(pipeline, "plan_pack", lambda *args: plan)
    items = dict(zip(("can_2", "can_3"), plan.objects.values(), strict=True))
    second = replace(plan, objects=items, placements=tuple(further))
    monkeypatch.setattr(pipeline, "plan_further", lambda *args: second)
    monkeypatch.setattr(pipeline, "execute", lambda plan, *args: executed.append(plan) or [])
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), rounds=4))
    assert [[p.name for p in plan.placements] for plan in executed] == [["can_1"], ["can_2", "can_3"]]


@pytest.mark.parametrize("error", [PerceptionError("no plane"), PlanningError("none can be manipulated")])
def test_a_further_round_that_fails_keeps_the_results(stages, monkeypatch, error):
    stages.stage("plan_further", error)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and result.outcomes == stages.outcomes and result.checks == {0: SEEN}
    assert len(stages.scanner.visited) == 3, "two scans and the verification"


def test_what_was_left_in_the_box_is_tried_once_more_and_then_stays_there(stages, pack_plan, monkeypatch):
    lying = replace(stages.objects[1], T_world_object=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.03])))
    planned, executed = [], []

    def plan_further(objects, placed, *args):
        planned.append(([e for e in objects if e is lying], "can_1" in placed))
        return pack_plan

    def execute(plan, *args):
        executed.append(plan)
        return stages.outcomes

    monkeypatch.setattr(pipeline, "left_in_box", lambda result, box: [lying])
    monkeypatch.setattr(
        pipeline, "items_left", lambda result, left: {e.name: to_standing(stages.objects[1]) for e in left}
    )
    monkeypatch.setattr(pipeline, "plan_further", plan_further)
    monkeypatch.setattr(pipeline, "execute", execute)
    monkeypatch.setattr(pipeline, "is_something_left", lambda *args: len(executed) < 3)
    run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert planned[:2] == [([lying], False), ([], True)]


def test_sorting_has_one_round(stages):
    run(StillRobot(), stages.perception, TaskRequest("sort", Box()))
    assert len(stages.scanner.visited) == 2


def test_placed_objects_are_verified_beside_one_another(stages, overhead_frame, monkeypatch):
    calls = []
    monkeypatch.setattr(pipeline, "refit_pose", lambda *args: calls.append(args) or SEEN)
    placed = {estimate.id: estimate for estimate in stages.objects}
    assert verify(placed, [overhead_frame]) == {0: SEEN, 1: SEEN}
    for object_id, (estimate, frames, T, others) in enumerate(calls):
        assert estimate.id == object_id and frames == [overhead_frame]
        np.testing.assert_array_equal(T, estimate.T_world_object)
        assert [other.id for other in others] == [1 - object_id]


def test_what_fell_in_the_box_is_placed_again_and_verified_again(stages, pack_plan, monkeypatch):
    lying = replace(stages.objects[0], T_world_object=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.03])))
    results, executed, plans = iter([[lying], []]), [], []
    again = replace(stages.outcomes[0], attempts=2)

    def execute(plan, *args):
        executed.append(plan)
        return stages.outcomes if len(executed) == 1 else [again]

    def plan_further(objects, placed, box, *args):
        plans.append((objects, dict(placed)))
        name = objects[0].name
        item = replace(first.objects[name], T_world_stand=pose_from_yaw(0.3, np.array([0.4, 0.3, 0.0])))
        return replace(first, objects={name: item}, left_out={})

    first = pack_plan
    monkeypatch.setattr(pipeline, "fallen_objects", lambda *args: next(results))
    monkeypatch.setattr(pipeline, "execute", execute)
    monkeypatch.setattr(pipeline, "plan_further", plan_further)
    monkeypatch.setattr(pipeline, "is_something_left", lambda *args: False)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == 2
    ((objects, placed),) = plans
    assert objects == [lying] and placed == {}, "it is no longer among what stands in the box"
    assert [o.attempts for o in result.outcomes] == [2]
    (first,) = (e for e in result.objects if e.id == 0)
    np.testing.assert_allclose(first.T_world_object, stages.objects[0].T_world_object, atol=1e-9)
    assert len(stages.scanner.visited) == 3, "one scan and two verifications"


def test_a_bowl_beside_the_one_that_it_fits_into_is_placed_again_once(stages, pack_plan, monkeypatch):
    loose = to_standing(stages.objects[0])
    again = replace(stages.outcomes[0], attempts=2)
    executed, named = [], []
    monkeypatch.setattr(pipeline, "fallen_objects", lambda *args: [])
    monkeypatch.setattr(pipeline, "loose_bowl", lambda *args: loose)
    monkeypatch.setattr(pipeline, "with_bowls_named", lambda result, *args: named.append(result) or result)

    def execute(plan, *args):
        executed.append(plan)
        return stages.outcomes if len(executed) == 1 else [again]

    monkeypatch.setattr(pipeline, "execute", execute)
    monkeypatch.setattr(pipeline, "plan_further", lambda found, *args: pack_plan)
    monkeypatch.setattr(pipeline, "is_something_left", lambda *args: False)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == 2 and len(named) == 2
    assert [o.attempts for o in result.outcomes] == [2]


@pytest.mark.parametrize(("unplaced", "rounds"), [(True, 3), (False, 2)])
def test_once_something_was_placed_again_there_may_be_room(stages, pack_plan, monkeypatch, unplaced, rounds):
    loose, executed = to_standing(stages.objects[0]), []
    monkeypatch.setattr(pipeline, "fallen_objects", lambda *args: [])
    monkeypatch.setattr(pipeline, "loose_bowl", lambda *args: loose)
    monkeypatch.setattr(pipeline, "with_bowls_named", lambda result, *args: result)
    monkeypatch.setattr(pipeline, "execute", lambda plan, *args: executed.append(plan) or stages.outcomes)
    monkeypatch.setattr(pipeline, "plan_further", lambda found, *args: pack_plan)
    monkeypatch.setattr(pipeline, "is_something_left", lambda *args: len(executed) == 2)
    monkeypatch.setattr(pipeline, "is_something_unplaced", lambda result: unplaced)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and len(executed) == rounds


def test_what_cannot_be_placed_again_ends_the_task_as_it_is(stages, monkeypatch):
    monkeypatch.setattr(pipeline, "fallen_objects", lambda *args: [stages.objects[0]])
    monkeypatch.setattr(pipeline, "is_something_left", lambda *args: False)
    stages.stage("plan_further", PlanningError("no room"))
    result = run(StillRobot(), stages.perception, TaskRequest("pack", Box()))
    assert result.failure == "" and result.outcomes == stages.outcomes and result.checks == {0: SEEN}
