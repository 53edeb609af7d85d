from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from manipulation.grasps import grasp_candidates
from manipulation.robot import JointTrajectory
from manipulation.standing import to_standing
from manipulation.types import Box, GraspSet, Line, PickPlacePlan, Placement
from perception.geometry import pose_from_yaw, rigid, so3_exp


def standing(shapes, category, mesh, **where):
    return to_standing(shapes.estimate(1, category, mesh, **where))


def test_box_height_is_the_floor_and_the_depth():
    assert Box(size=(0.3, 0.2, 0.1), floor=0.006).top == pytest.approx(0.106)


def test_contents_move_as_what_they_are_in(shapes):
    """A quarter turn about the object's new place takes its contents along."""
    T_rest = pose_from_yaw(np.pi / 2, np.array([0.5, 0.3, 0.1]))
    grasp = grasp_candidates(standing(shapes, "can", shapes.can())).grasps[0]
    goal = Placement("bowl", (0.5, 0.3, 0.1), (0.0,))
    still = JointTrajectory(0.01, *np.zeros((3, 1, 7)))
    motions = dict.fromkeys(("transit", "approach", "lift", "carry", "lowering", "settle", "retreat"), still)
    plan = PickPlacePlan("bowl", grasp, goal, T_rest, T_rest, 0.05, **motions, contents=("inner",))
    poses = {"bowl": np.eye(4), "inner": pose_from_yaw(0.0, np.array([0.1, 0.0, 0.0])), "beside": np.eye(4)}
    after = plan.poses_after(poses)
    assert after.keys() == {"bowl", "inner"}
    np.testing.assert_allclose(after["bowl"], T_rest)
    np.testing.assert_allclose(after["inner"][:3, 3], [0.5, 0.4, 0.1], atol=1e-12)


def test_an_object_that_has_shifted_in_the_hand_is_left_in_the_same_direction_of_the_hand(shapes):
    grasp = grasp_candidates(standing(shapes, "can", shapes.can())).grasps[0]
    shift = pose_from_yaw(0.2, np.array([0.01, 0.0, 0.002])) @ rigid(
        so3_exp(np.array([0.1, 0.0, 0.0])), np.zeros(3)
    )
    held = grasp.held_at(shift @ grasp.T_stand_tcp)
    np.testing.assert_allclose(held.T_stand_tcp, shift @ grasp.T_stand_tcp)
    in_hand = [g.T_stand_tcp[:3, :3].T @ g.away for g in (grasp, held)]
    np.testing.assert_allclose(*in_hand, atol=1e-12)
    assert held.held_width == grasp.held_width and held.release_opening == grasp.release_opening


def test_length_and_direction_of_a_line():
    line = Line((0.1, 0.2), (-0.2, 0.6))
    assert line.length == pytest.approx(0.5)
    assert line.direction == pytest.approx([-0.6, 0.8])


def test_the_hand_stands_off_along_its_closing_direction_before_it_closes(shapes):
    grasp = replace(grasp_candidates(standing(shapes, "can", shapes.can())).grasps[0], stand_off=0.004)
    step = grasp.T_stand_tcp[:3, 3] - grasp.T_stand_open[:3, 3]
    assert step == pytest.approx(0.004 * grasp.T_stand_tcp[:3, 1])
    assert (grasp.T_stand_open[:3, :3] == grasp.T_stand_tcp[:3, :3]).all()


def test_top_of_an_object_is_its_highest_vertex(shapes):
    assert standing(shapes, "can", shapes.can(height=0.11)).top == pytest.approx(0.11)


def test_failure_message_lists_the_four_most_frequent_reasons():
    reasons = Counter({"too low": 3, "too wide": 9, "too tapered": 4, "at the handle": 2, "other": 1})
    found = GraspSet((), reasons)
    assert found.n_candidates == 19
    assert found.failure_message("can_1") == (
        "No grasp for can_1: of 19 candidates, 9 too wide, 4 too tapered, 3 too low, 2 at the handle; "
        "exclude it or use a wider gripper"
    )


def test_a_wider_gripper_is_a_remedy_for_what_is_too_wide_alone():
    found = GraspSet((), Counter({"too low": 5, "too wide for 0.08 m": 2}))
    assert found.failure_message("can_1").endswith("5 too low, 2 too wide for 0.08 m; exclude it")


def test_failure_message_of_a_can_that_is_too_wide(shapes):
    found = grasp_candidates(standing(shapes, "can", shapes.can(radius=0.05)))
    assert found.failure_message("can_1") == (
        "No grasp for can_1: of 72 candidates, 72 too wide for 0.08 m; exclude it or use a wider gripper"
    )


def test_the_position_on_a_line_and_the_distance_from_its_segment():
    line = Line((0.2, 0.1), (0.2, 0.5))
    assert line.position(np.array([0.23, 0.3])) == pytest.approx((0.2, 0.03))
    assert line.position(np.array([0.2, 0.53])) == pytest.approx((0.43, 0.03))
    assert line.position(np.array([0.17, 0.06])) == pytest.approx((-0.04, 0.05)), (
        "beyond the start and beside it"
    )
