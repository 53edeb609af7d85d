"""Order and data flow of the stages, with each stage replaced by one that records its arguments."""

import pytest

from app.task.pipeline import run
from app.task.task_types import TaskRequest
from manipulation.errors import PlanningError
from manipulation.types import Box, Line
from manipulation.viewpoints import BOX_VIEWPOINTS, LINE_VIEWPOINTS, SCAN_VIEWPOINTS
from perception.errors import PerceptionError
from tests.app.task.conftest import DETECTOR, FOUND, SEEN, Recording, StillRobot


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


@pytest.mark.parametrize(("rounds", "visits"), [(1, 2), (2, 3)])
def test_sorting_looks_again_as_often_as_it_may_while_something_is_left(stages, rounds, visits):
    run(StillRobot(), stages.perception, TaskRequest("sort", Box(), rounds=rounds))
    assert len(stages.scanner.visited) == visits, "the last time to verify"
