"""Images, fits and checks of the stages, with what they call replaced."""

from dataclasses import replace

import numpy as np
import pytest

from app.task.further_views import MOST_CLOSER
from app.task.pipeline import run
from app.task.stages import verify
from app.task.task_types import TaskRequest
from manipulation.errors import PlanningError
from manipulation.planner import ManipulationConfig
from manipulation.types import Box
from manipulation.workspace import Workspace
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import RejectedObject, SupportPlane
from tests.app.task.conftest import DETECTOR, FOUND, SEEN, Recording, StillRobot


def test_objects_of_the_first_half_of_the_images_are_the_starts_of_the_fits(stages):
    calls = []

    def reconstruct_objects(frames, detections, decoder, *args, **options):
        calls.append((len(frames), options.get("starts"), options.get("clutter")))
        return stages.objects

    stages.replace("reconstruct_objects", reconstruct_objects)
    request = TaskRequest("pack", scan_views=2, perceive_only=True)
    run(StillRobot(), stages.perception, request)
    assert calls == [(1, None, None), (1, tuple(stages.objects), DETECTOR)]
    calls.clear()
    run(StillRobot(), stages.perception, TaskRequest("pack", scan_views=1, perceive_only=True))
    assert calls == [(1, (), DETECTOR)]


def test_other_sources_of_shapes_need_no_early_fits(stages):
    stages.replace("reconstruct_objects", lambda *args, **options: pytest.fail("fitted"))
    request = TaskRequest(
        "pack", reconstruction=lambda f, d: stages.objects, scan_views=2, perceive_only=True
    )
    assert run(StillRobot(), stages.perception, request).objects == stages.objects


def test_a_further_image_is_fused_with_those_before_while_objects_are_uncertain(stages):
    answers, asked, offered = [2, None], [], []

    def choose(objects, rejected, viewpoints, arm, config):
        asked.append((len(viewpoints), [item.name for item in rejected]))
        offered.append(tuple(viewpoints))
        answer = answers.pop(0)
        return None if answer is None else viewpoints[answer]

    def reconstruct(frames, detections, decoder, progress, on_step, on_rejected, clutter, starts):
        on_rejected(RejectedObject(len(frames), "mug", "seen from one side"))
        return stages.objects

    stages.replace("detect", lambda frames, *_, **__: empty(len(frames)))
    stages.replace("most_useful_viewpoint", choose)
    stages.replace("reconstruct_objects", reconstruct)
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
def test_the_scan_is_complete_where_nothing_more_can_be_seen(stages, error):
    def choose(objects, rejected, viewpoints, arm, config):
        stages.scanner.error = error
        return viewpoints[0]

    stages.replace("detect", lambda frames, *_, **__: empty(len(frames)))
    stages.replace("most_useful_viewpoint", choose)
    off = TaskRequest("pack", scan_views=1, perceive_only=True, uncertainty=False)
    assert len(run(StillRobot(), stages.perception, off).frames) == 1
    on = TaskRequest("pack", scan_views=1, perceive_only=True)
    assert len(run(StillRobot(), stages.perception, on).frames) == (6 if error is None else 1)


def test_hidden_places_are_looked_at_before_what_is_uncertain(stages):
    asked = []

    def reveal(frames, objects, area, viewpoints, plane):
        asked.append((len(frames), [e.id for e in objects], area, tuple(viewpoints), plane.offset))
        return list(viewpoints[1:3]) if len(frames) == 1 else []

    def choose(objects, rejected, viewpoints, arm, config):
        asked.append(len(viewpoints))

    stages.replace("detect", lambda frames, *_, **__: empty(len(frames)))
    stages.replace("revealing_viewpoints", reveal)
    stages.replace("most_useful_viewpoint", choose)
    run(StillRobot(), stages.perception, TaskRequest("pack", scan_views=1, perceive_only=True))
    area, left = ManipulationConfig().free_area, Workspace().further_viewpoints(1)
    still_left, ids = (left[0], *left[3:]), [e.id for e in stages.objects]
    assert asked == [
        (1, ids, area, left, 0.0),
        (2, ids, area, still_left, 0.0),
        len(still_left),
    ]
    assert stages.scanner.visited[1] == left[1:3]


def test_what_the_borders_cut_is_looked_at_from_nearby_once(stages, can_at):
    asked = []

    def cut_by_borders(objects, frames):
        asked.append((objects, len(frames)))
        return [(0.3, -0.05)] * 4

    stages.replace("detect", lambda frames, *_, **__: empty(len(frames)))
    stages.replace("cut_by_borders", cut_by_borders)
    request = TaskRequest("pack", perceive_only=True)
    result = run(StillRobot(), stages.perception, request)
    assert asked == [(stages.objects, 1)] and len(result.frames) == 2
    assert stages.scanner.visited[1] == Workspace().closeup_viewpoints(0.3, -0.05) * MOST_CLOSER
    shapes = replace(request, reconstruction=lambda frames, detections: stages.objects)
    assert len(run(StillRobot(), stages.perception, shapes).frames) == 1, "true shapes are known whole"


def test_a_thing_that_no_image_shows_whole_is_looked_at_from_nearby_once(stages):
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    thing = PerceivedObstacle(0, (0.1 * corners + (0.3, -0.07, 0.1),), 100)
    seen = []

    def obstacles_beside(objects, frames, *args):
        seen.append(len(frames))
        return (thing,)

    stages.replace("detect", lambda frames, *_, **__: empty(len(frames)))
    stages.replace("obstacles_beside", obstacles_beside)
    observer = Recording()
    result = run(StillRobot(), stages.perception, TaskRequest("pack", perceive_only=True), observer)
    assert seen == [1, 2] and len(result.frames) == 2 and result.obstacles == (thing,)
    assert stages.scanner.visited[1] == Workspace().closeup_viewpoints(0.3, -0.07)
    assert sum(isinstance(c, tuple) and c[0] == "objects" for c in observer.calls) == 1


def test_without_uncertainty_the_plan_takes_shapes_as_exact(stages, can_at):
    stages.replace("most_useful_viewpoint", lambda *args: None)
    vague = replace(can_at(0), surface_sigma=np.full(len(can_at(0).mesh.vertices), 0.01))
    stages.stage("reconstruct_objects", [vague])
    for uncertainty in (True, False):
        request = TaskRequest("pack", uncertainty=uncertainty, rounds=1)
        assert run(StillRobot(), stages.perception, request).failure == ""
        (planned,) = stages.calls["plan_pack"][0]
        assert (planned.surface_sigma is not None) == uncertainty


def test_a_scaled_cell_has_its_own_viewpoints_and_heights(stages):
    run(StillRobot(), stages.perception, TaskRequest("pack", Box(), workspace=Workspace(0.8), rounds=1))
    scan, box = stages.scanner.visited
    assert scan == Workspace(0.8).scan_viewpoints() and box == Workspace(0.8).box_viewpoints
    for call in ("plan_pack", "execute"):
        (settings,) = (a for a in stages.calls[call] if isinstance(a, ManipulationConfig))
        assert settings == Workspace(0.8).adapted(ManipulationConfig())


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


def test_objects_that_are_left_out_are_in_the_result(stages):
    def reconstruct(frames, detections, decoder, progress, on_step, on_rejected, clutter, starts):
        on_rejected(RejectedObject(7, "mug", "the fit failed"))
        return stages.objects

    stages.replace("reconstruct_objects", reconstruct)
    result = run(StillRobot(), stages.perception, TaskRequest("pack", rounds=1))
    assert [item.name for item in result.rejected] == ["mug_7"] and result.objects == stages.objects


def test_placed_objects_are_verified_beside_one_another(stages, overhead_frame):
    calls = []
    stages.replace("refit_pose", lambda *args: calls.append(args) or SEEN)
    placed = {estimate.id: estimate for estimate in stages.objects}
    assert verify(placed, [overhead_frame]) == {0: SEEN, 1: SEEN}
    for object_id, (estimate, frames, T, others) in enumerate(calls):
        assert estimate.id == object_id and frames == [overhead_frame]
        np.testing.assert_array_equal(T, estimate.T_world_object)
        assert [other.id for other in others] == [1 - object_id]


def test_the_network_is_asked_for_the_handles_of_standing_mugs(stages, overhead_frame):
    mug, can = (replace(e, category=c) for e, c in zip(stages.objects, ("mug", "can"), strict=True))
    asked, directions = [], []
    stages.replace("refit_pose", lambda *args: SEEN)
    stages.replace("handle_yaw", lambda *args, **kwargs: asked.append((args, kwargs)) or 0.5)

    def turned(estimate, frames, T, others, see_yaw):
        directions.append(None if see_yaw is None else see_yaw(estimate))

    stages.replace("refit_turned", turned)
    placed, network = {mug.id: mug, can.id: can}, stages.perception.detector
    assert verify(placed, [overhead_frame], network) == {mug.id: SEEN, can.id: SEEN}
    ((estimate,), known) = asked[0]
    assert directions == [0.5] and estimate is mug and known["network"] is network
    assert known["others"] == [can] and known["frames"] == [overhead_frame]
    verify(placed, [overhead_frame])
    assert directions == [0.5, None] and len(asked) == 1
