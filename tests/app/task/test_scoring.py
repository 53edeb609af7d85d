"""Scores against true states that are made up, with real object models."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.task.scoring import (
    Truth,
    match,
    oracle_estimates,
    score_reconstruction,
    score_task,
    unknown_moves,
)
from manipulation.standing import to_standing
from manipulation.types import Line, ObjectOutcome, Placement, TaskPlan
from perception.types import TriangleMesh
from sim_assets.cell.scene import BoxConfig
from sim_assets.objects import sample_object


def at(x, y, z=0.0, yaw=0.0):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = (x, y, z)
    return T


@pytest.fixture(scope="module")
def truth():
    rng = np.random.default_rng(0)
    models = {i: sample_object(c, "test", rng) for i, c in enumerate(("mug", "can", "bowl"))}
    return Truth(models, {0: at(0.4, -0.3, yaw=2.0), 1: at(0.5, -0.1), 2: at(0.55, -0.4, yaw=-1.0)})


def moved(estimate, offset):
    T = np.array(estimate.T_world_object)
    T[:3, 3] += offset
    return replace(estimate, T_world_object=T)


def test_oracle_estimates_are_the_true_objects(truth):
    estimates = oracle_estimates(truth)
    for estimate in estimates:
        model, T = truth.models[estimate.id], truth.poses[estimate.id]
        true = np.asarray(model.mesh.vertices) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(estimate.mesh_world.vertices, true, atol=1e-9)
        assert estimate.height == pytest.approx(model.height, abs=1e-3)
        assert estimate.radius == pytest.approx(model.radius, abs=1e-3)
        assert (
            np.abs(estimate.mesh.vertices).max() <= 0.9 * estimate.scale[0] + 1e-6
        )  # fills the canonical cube


def test_estimates_are_matched_by_position_whatever_their_order_and_class(truth):
    estimates = [moved(estimate, (0.01, -0.01, 0.0)) for estimate in oracle_estimates(truth)]
    renamed = [replace(estimates[2], id=7, category="can"), replace(estimates[0], id=8)]
    assert match(renamed, truth) == {7: 2, 8: 0}
    far = [moved(estimates[1], (0.2, 0.2, 0.0))]
    assert match(far, truth) == {} and match([], truth) == {}


@pytest.mark.parametrize(("distance", "matched"), [(0.049, True), (0.051, False)])
def test_estimates_farther_than_five_centimetres_are_not_matched(truth, distance, matched):
    can = oracle_estimates(truth)[1]
    assert match([moved(can, (0.0, distance, 0.0))], truth) == ({1: 1} if matched else {})


def test_the_axis_of_a_mug_is_that_of_its_body(truth):
    """The handle moves the centre of the bounding box by about 2 cm along +x."""
    mug = oracle_estimates(truth)[0]
    along_handle = truth.poses[0][:3, 0]
    assert match([moved(mug, 0.045 * along_handle)], truth) == {0: 0}
    assert match([moved(mug, -0.045 * along_handle)], truth) == {0: 0}


def test_a_lying_object_is_matched_at_its_middle(truth):
    on_side = truth.poses[1].copy()
    on_side[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    lying = Truth({1: truth.models[1]}, {1: on_side})
    (can,) = oracle_estimates(lying)
    for side in (0.04, -0.04):
        assert match([moved(can, (side, 0.0, 0.0))], lying) == {1: 1}


def test_objects_on_each_other_are_matched_by_height(truth):
    raised = truth.poses[1].copy()
    raised[2, 3] += truth.models[1].height
    stack = Truth({1: truth.models[1], 2: truth.models[1]}, {1: truth.poses[1], 2: raised})
    lower, upper = oracle_estimates(stack)
    for estimates in ([lower, moved(upper, (0.003, 0.0, 0.01))], [moved(upper, (0.0, 0.003, 0.0)), lower]):
        assert match(estimates, stack) == {1: 1, 2: 2}


def test_what_stands_beside_the_middle_of_a_bowl_is_told_from_the_bowl(truth):
    """Their axes are apart by 3 cm, and the estimates of both are off towards each other's."""
    raised, aside = truth.poses[2].copy(), np.array((0.03, 0.0, 0.0))
    raised[:3, 3] += aside
    raised[2, 3] += 0.02
    stack = Truth({1: truth.models[1], 2: truth.models[2]}, {1: raised, 2: truth.poses[2]})
    can, bowl = oracle_estimates(stack)
    assert match([moved(can, -0.8 * aside), moved(bowl, 0.8 * aside)], stack) == {1: 1, 2: 2}


def test_two_estimates_of_one_object_leave_one_unmatched(truth):
    can = oracle_estimates(truth)[1]
    near, far = replace(can, id=5), replace(moved(can, (0.02, 0.0, 0.0)), id=6)
    assert match([far, near], truth) == {5: 1}


def test_reconstruction_scores_know_perfect_from_shifted_and_missing(truth):
    rng = np.random.default_rng(1)
    mug, can, _ = oracle_estimates(truth)
    rows = score_reconstruction([mug, moved(can, (0.0, 0.0, 0.02))], truth, rng)
    perfect, shifted, missing = rows
    assert perfect["accuracy"] < 0.0012 and perfect["completion"] == 1.0 and perfect["handle_recall"] > 0.99
    assert 0.003 < shifted["accuracy"] < 0.02 and "handle_recall" not in shifted
    assert missing["found"] is False and "accuracy" not in missing


def test_rows_tell_how_objects_rest_and_were_estimated(truth):
    turned = truth.poses[1] @ np.diag([1.0, -1.0, -1.0, 1.0])
    turned[2, 3] = 2 * truth.models[1].height  # a can upside down on another one
    tower = Truth({0: truth.models[0], 1: truth.models[1]}, {0: truth.poses[0], 1: turned})
    mug, can = oracle_estimates(tower)
    can = replace(can, T_world_object=can.T_world_object @ np.diag([1.0, -1.0, -1.0, 1.0]))
    mug = replace(mug, T_world_object=mug.T_world_object @ np.diag([1.0, -1.0, -1.0, 1.0]))
    of_mug, of_can = score_reconstruction([mug, can], tower, np.random.default_rng(1))
    assert (of_mug["resting"], of_mug["stacked"]) == ("upright", False)
    assert (of_can["resting"], of_can["stacked"]) == ("upside-down", True)
    assert of_can["axis_error"] == pytest.approx(0) and of_mug["axis_error"] == pytest.approx(np.pi)


def test_a_handle_on_the_wrong_side_has_no_recall(truth):
    mug = oracle_estimates(truth)[0]
    vertices = np.array(mug.mesh.vertices) * (-1, -1, 1)
    turned = replace(mug, mesh=TriangleMesh(vertices, mug.mesh.faces))
    row = score_reconstruction([turned], truth, np.random.default_rng(1))[0]
    assert row["handle_recall"] < 0.5


def plan_for(estimates, left_out=None):
    items = {estimate.name: to_standing(estimate) for estimate in estimates}
    placements = tuple(Placement(name, (0.5, 0.3, 0.0), (0.0,)) for name in items)
    return TaskPlan("pack", items, placements, left_out or {})


def test_every_object_has_its_reason(truth):
    mug, can, bowl = oracle_estimates(truth)
    box = BoxConfig()
    packed = {0: at(0.45, 0.25, box.floor), 1: truth.poses[1], 2: truth.poses[2]}
    outcomes = [
        ObjectOutcome(0, mug.name, True, 2, "", at(0.45, 0.255)),
        ObjectOutcome(1, can.name, False, 3, "nothing between the fingers"),
    ]
    plan = plan_for([mug, can])
    reports = score_task(plan, [mug, can], outcomes, truth, Truth(truth.models, packed), box)
    first, second, third = reports
    assert first.placed and first.error_position == pytest.approx(0.005) and first.attempts == 2
    assert not second.placed and second.reason == "nothing between the fingers"
    assert not third.placed and third.reason.startswith("not perceived (outside the box") and third.id == -3
    plan = plan_for([mug, can, bowl], {can.name: "out of reach"})
    reports = score_task(plan, [mug, can, bowl], outcomes[:1], truth, Truth(truth.models, packed), box)
    assert reports[1].reason == "not attempted: out of reach"
    reports = score_task(None, [mug, can, bowl], [], truth, truth, box)
    assert {report.reason for report in reports} == {"no plan"}


def test_what_the_robot_believes_does_not_count(truth):
    mug, can, bowl = oracle_estimates(truth)
    believed = [ObjectOutcome(e.id, e.name, True, 1, "", at(0.5, 0.27)) for e in (mug, can, bowl)]
    reports = score_task(plan_for([mug, can, bowl]), [mug, can, bowl], believed, truth, truth, BoxConfig())
    assert not any(report.placed for report in reports)


def test_an_object_that_toppled_or_tilted_is_not_placed(truth):
    mug, can, bowl = oracle_estimates(truth)
    box = BoxConfig()
    outcome = ObjectOutcome(1, can.name, True, 1, "", at(0.45, 0.25))
    for degrees, reason in ((9, ""), (11, "tilted by 11 deg"), (90, "toppled by 90 deg")):
        tilt = np.deg2rad(degrees)
        T = at(0.45, 0.25, box.floor)
        T[:3, :3] = [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
        after = Truth(truth.models, {**truth.poses, 1: T})
        report = score_task(plan_for([mug, can, bowl]), [mug, can, bowl], [outcome], truth, after, box)[1]
        assert (report.placed, report.reason) == (not reason, reason)
        assert report.error_tilt == pytest.approx(tilt) and report.error_position == pytest.approx(
            0, abs=1e-9
        )


def test_the_position_error_is_horizontal(truth):
    can = oracle_estimates(truth)[1]
    outcome = ObjectOutcome(1, can.name, True, 1, "", at(0.5, -0.1) @ at(0.003, 0.004, 0.3))
    report = score_task(plan_for([can]), [can], [outcome], truth, truth, BoxConfig())[1]
    assert report.error_position == pytest.approx(0.005)
    assert score_task(plan_for([can]), [can], [], truth, truth, BoxConfig())[1].error_position is None


def test_estimates_are_matched_where_objects_stood_and_judged_where_they_stand(truth):
    """The true can ends in the box, the true mug where the can was before."""
    _, can, _ = oracle_estimates(truth)
    box = BoxConfig()
    after = Truth(truth.models, {**truth.poses, 1: at(0.45, 0.25, box.floor), 0: truth.poses[1]})
    reports = score_task(plan_for([can]), [can], [], truth, after, box)
    assert reports[1].placed and reports[1].id == can.id and reports[1].details["perceived"] == "can"
    assert not reports[0].placed and reports[0].details["perceived"] is None


def test_uncertainty_is_scored_against_the_true_surface(truth):
    can = oracle_estimates(truth)[1]

    def row(error, sigma):
        """A can whose surface is ``error`` outside the true one, with a standard deviation of ``sigma``."""
        mesh = truth.models[1].mesh
        vertices = np.asarray(mesh.vertices) + error * np.asarray(mesh.vertex_normals)
        centre = np.asarray(mesh.vertices)[0] - np.asarray(can.mesh.vertices)[0]
        shifted = TriangleMesh(vertices - centre, can.mesh.faces)
        sigmas = np.full(len(vertices), sigma)
        estimate = replace(can, mesh=shifted, surface_sigma=sigmas)
        return score_reconstruction([estimate], truth, np.random.default_rng(0))[1]

    exact = row(0.002, 0.003)
    assert exact["surface_sigma"] == pytest.approx(0.003)
    assert exact["within_1_sigma"] > 0.95
    between = row(0.0045, 0.003)
    assert between["within_1_sigma"] < 0.2 and between["within_2_sigma"] > 0.8


def test_bowls_that_fit_must_be_nested_and_seated():
    rng = np.random.default_rng(0)
    bowls = {i: sample_object("bowl", "test", rng) for i in range(2)}
    large, small = sorted(bowls, key=lambda i: -bowls[i].radius)
    before = Truth(bowls, {0: at(0.4, -0.3), 1: at(0.5, -0.1)})
    box = BoxConfig()

    def reasons(**small_at):
        poses = {
            large: at(0.43, 0.27, box.floor),
            small: at(**{"x": 0.43, "y": 0.27, "z": box.floor} | small_at),
        }
        reports = score_task(None, [], [], before, Truth(bowls, poses), box)
        return [report.reason for report in reports if report.reason]

    assert reasons(z=box.floor + 0.4 * bowls[large].height) == []
    assert reasons(x=0.58) == ["not perceived (bowl beside the nest)"]
    (high,) = reasons(z=box.floor + 0.9 * bowls[large].height)
    assert high.startswith("not perceived (bowl not seated in the nest")


def test_sorting_is_scored_on_the_line(truth):
    line = Line()
    order = sorted(truth.models, key=lambda i: truth.objects[i].size)
    start, along = np.array(line.start), line.direction
    poses = {i: at(*(start + (0.1 + 0.25 * rank) * along)) for rank, i in enumerate(order)}
    estimates = oracle_estimates(truth)
    reports = score_task(plan_for(estimates), estimates, [], truth, Truth(truth.models, poses), None)
    assert all(report.placed for report in reports)


def test_moved_and_toppled_things_of_no_class_are_told_apart():
    def turned(axis, degrees, shift=0.0):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        T[0, 3] = shift
        return T

    # Thing 3 lies on its side and rolls about the vertical.
    starts = [np.eye(4), np.eye(4), np.eye(4), turned("x", 90)]
    ends = [turned("z", 5, 0.004), turned("z", 0, 0.02), turned("y", 80), turned("z", 40) @ turned("x", 90)]
    before, after = (Truth({}, {}, dict(enumerate(poses))) for poses in (starts, ends))
    rows = unknown_moves(before, after)
    assert [row["moved"] for row in rows] == [False, True, True, True]
    assert [row["toppled"] for row in rows] == [False, False, True, False]
    assert rows[2]["tilt"] == pytest.approx(np.deg2rad(80)) and rows[3]["tilt"] == pytest.approx(0, abs=1e-6)
