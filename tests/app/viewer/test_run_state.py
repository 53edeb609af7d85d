"""Effect of each note on the state of a run."""

import numpy as np
import pytest

from app.runs.replay import Note, Recorder
from app.viewer.run_state import RunState
from perception.geometry import pose_from_yaw


def upright(x, y, z=0.0):
    return pose_from_yaw(0.0, np.array([x, y, z], dtype=np.float64))


DOWNWARDS = np.diag([1.0, -1.0, -1.0, 1.0])  # orientation of a gripper


def apply(state, *notes, recorder=None):
    for kind, data in notes:
        state.apply(Note(0.0, kind, data), recorder or Recorder())
    return state


def action(phase, message="", **details):
    return "action", {"phase": phase, "name": "can_0", "message": message} | details


APPROACH = action(
    "approach",
    T_stand_tcp=upright(0, 0, 0.1) @ DOWNWARDS,
    T_world_stand_rest=upright(0.4, 0.2),
    grasps=[upright(0, 0, 0.08)],
)
POSES = np.array([[0.1, 0.3, 0.6, 0, 1, 0, 0.0]])  # of the TCP, pointing down


@pytest.fixture
def planned(make_can):
    """A can of the object map at (0.4, -0.2), with its goal at (0.4, 0.2) turned by 90 degrees."""
    recorder = Recorder(objects=(make_can(0), make_can(1)))
    placement = {"name": "can_0", "T_world_stand": upright(0.4, -0.2).tolist(), "position": (0.4, 0.2, 0.0)}
    placement["yaws"] = (np.pi / 2, 0.0)
    plan = {"placements": [placement], "left_out": {"can_1": "out of reach"}}
    return apply(RunState(), ("objects", {"covariances": {}}), ("plan", plan), recorder=recorder)


def shown(state):
    return state.snapshot(0.0, POSES, ("tcp",))


def test_images_are_counted_and_searched_later_in_a_task_but_at_once_in_slam():
    state = apply(RunState(), ("stage", {"name": "scan"}), ("look", {"index": 4}))
    assert (state.n_frames, state.n_searched) == (5, 0)
    apply(state, ("found", {"index": 2, "count": 1}))
    assert (state.n_frames, state.n_searched) == (5, 3)
    slam = apply(RunState(), ("stage", {"name": "slam"}), ("look", {"index": 4}))
    assert slam.n_searched == 5


def test_the_ghost_is_at_the_goal_pose_of_the_plan_not_at_the_start(planned):
    T = shown(planned).goals["can_0"]
    np.testing.assert_allclose(T, pose_from_yaw(np.pi / 2, np.array([0.4, 0.2, 0.05])), atol=1e-9)
    np.testing.assert_allclose(shown(planned).objects[0].T_world_object[:3, 3], (0.4, -0.2, 0.05))
    assert list(shown(planned).goals) == ["can_0"]
    apply(planned, ("stage", {"name": "verify"}))
    assert not shown(planned).goals


def test_objects_left_out_of_the_plan_have_its_reason(planned):
    objects = shown(planned).objects
    assert (objects[1].status, objects[1].reason) == ("not placed", "out of reach")
    assert (objects[0].status, objects[0].reason) == ("reconstructed", "")


@pytest.mark.parametrize(
    ("phase", "status"),
    [
        ("plan", "reconstructed"), ("approach", "next"), ("grasp", "held"), ("transfer", "held"),
        ("place", "held"), ("retreat", "placed"), ("placed", "placed"), ("retry", "not placed"),
        ("deferred", "not placed"), ("failed", "not placed"),
    ],
)  # fmt: skip
def test_the_status_follows_the_phase(planned, phase, status):
    apply(planned, ("path", {"points": [(0, 0, 0), (1, 1, 1)]}), action(phase, "slipped"))
    snapshot = shown(planned)
    assert snapshot.objects[0].status == status and snapshot.objects[1].status == "not placed"
    assert (snapshot.path is not None) == (phase in ("plan", "approach", "grasp", "transfer", "place"))
    assert ("can_0" in snapshot.goals) == (status != "placed")
    assert snapshot.objects[0].reason == ("slipped" if status == "not placed" else "")


def test_a_held_object_has_a_constant_pose_in_the_tcp_frame(planned):
    apply(planned, APPROACH)
    np.testing.assert_allclose(shown(planned).objects[0].T_world_object[:3, 3], (0.4, -0.2, 0.05))
    apply(planned, action("transfer"))
    held = shown(planned).objects
    # The TCP is 0.1 m above the support, the object's centre 0.05 m.
    np.testing.assert_allclose(held[0].T_world_object, upright(0.1, 0.3, 0.55), atol=1e-9)
    np.testing.assert_allclose(held[1].T_world_object[:3, 3], (0.4, -0.2, 0.05))  # the other one stays
    assert planned.snapshot(0.0, POSES, ("camera",)).objects[0].T_world_object[1, 3] == -0.2


def test_a_released_object_is_at_the_planned_resting_pose(planned):
    apply(planned, APPROACH, action("transfer"), action("retreat"))
    np.testing.assert_allclose(shown(planned).objects[0].T_world_object, upright(0.4, 0.2, 0.05), atol=1e-9)


def test_grasp_candidates_are_shown_during_the_approach_with_the_selected_one_first(planned):
    apply(planned, APPROACH)
    grasps = shown(planned).grasps
    np.testing.assert_allclose(grasps[0], upright(0.4, -0.2, 0.1) @ DOWNWARDS, atol=1e-9)
    np.testing.assert_allclose(grasps[1], upright(0.4, -0.2, 0.08), atol=1e-9)
    apply(planned, action("grasp"))
    assert shown(planned).grasps is None


def test_a_new_stage_ends_the_action(planned):
    apply(planned, APPROACH, ("path", {"points": [(0, 0, 0), (1, 1, 1)]}), ("stage", {"name": "verify"}))
    snapshot = shown(planned)
    assert snapshot.path is None and snapshot.grasps is None
    assert (snapshot.stage, snapshot.caption) == ("verify", "Verifying the placed objects in new images")


def test_a_fit_replaces_the_state_of_its_object_only(planned):
    fit = {
        "id": 0, "category": "bowl", "iteration": 8, "code": [0.5] * 16, "T_world_object": upright(1, 2, 3),
        "scale": [0.1, 0.2, 0.3], "residual": 0.004,
    }  # fmt: skip
    objects = shown(apply(planned, ("fit", fit))).objects
    state = objects[0]
    assert (state.name, state.iteration, state.residual, state.status) == ("bowl_0", 8, 0.004, "fitting")
    np.testing.assert_array_equal(state.T_world_object, upright(1, 2, 3))
    np.testing.assert_array_equal(state.scale, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(state.code, np.full(16, 0.5))
    assert objects[1].category == "can"


def test_snapshots_do_not_change_with_the_state(planned):
    before = shown(planned)
    apply(planned, APPROACH, action("placed"))
    assert before.objects[0].status == "reconstructed" and "can_0" in before.goals


def test_things_of_no_class_are_shown_from_their_note_on():
    corners = [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]
    state = apply(RunState(), ("obstacles", {"pieces": {"thing_0": [corners]}}))
    np.testing.assert_allclose(shown(state).obstacles["thing_0"][0], corners)
    assert not shown(RunState()).obstacles


def test_a_further_round_leaves_placed_objects_where_they_are(planned, make_can):
    apply(planned, APPROACH, action("retreat"), action("placed"))
    before = planned.objects[0].T_world_object
    goals = [
        {"name": name, "T_world_stand": upright(x, -0.2), "position": (x, 0.3, 0.0), "yaws": (0.0,)}
        for name, x in (("can_0", 0.4), ("can_2", 0.5))
    ]
    recorder = Recorder(objects=(make_can(0), make_can(2)))
    plan = {"placements": goals, "left_out": {}}
    apply(planned, ("objects", {"covariances": {}}), ("plan", plan), recorder=recorder)
    assert list(planned.objects) == [0, 2] and planned.objects[0].status == "placed"
    np.testing.assert_array_equal(planned.objects[0].T_world_object, before)
    assert list(planned.goals) == ["can_2"]
