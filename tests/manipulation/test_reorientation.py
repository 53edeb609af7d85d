import numpy as np
import pytest

from manipulation.antipodal_grasps import MIN_ELEVATION
from manipulation.reorientation import (
    lying_sides,
    reorienting_grasps,
    rolled,
    turning_goals,
)
from manipulation.standing import to_standing
from perception.geometry import pose_from_yaw

UP = np.array([0.0, 0.0, 1.0])
OVERTURNED = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def can(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(radius=0.03, height=0.075)))


@pytest.fixture(scope="module")
def mug(shapes):
    return to_standing(shapes.estimate(1, "mug", shapes.mug(radius=0.035)))


def on_side(radius=0.03):
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = 0.5, -0.2, radius
    return T


def test_a_short_can_on_its_side_is_grasped_at_an_angle(can):
    T_world_stand = on_side()
    grasps = reorienting_grasps(can, T_world_stand).grasps
    assert grasps and {grasp.kind for grasp in grasps} == {"antipodal"}
    for grasp in grasps:
        assert (T_world_stand[:3, :3] @ grasp.away)[2] >= np.sin(MIN_ELEVATION) - 1e-9, "above, now"
        assert grasp.away[2] >= np.sin(MIN_ELEVATION) - 1e-9, "above, when it stands"


def test_an_overturned_can_is_grasped_so_that_it_can_be_laid_on_its_side(can):
    grasps = reorienting_grasps(can, OVERTURNED).grasps
    assert grasps
    for grasp in grasps:
        assert -grasp.away[2] >= np.sin(MIN_ELEVATION) - 1e-9
        assert np.linalg.norm(grasp.away[:2]) >= np.sin(MIN_ELEVATION) - 1e-9
    azimuths = np.array([np.arctan2(grasp.away[1], grasp.away[0]) for grasp in grasps])
    assert np.ptp(azimuths) > np.pi / 2, "it may lie on any side"


def test_a_round_object_is_rolled_until_the_hand_is_above_it(can, mug):
    goal = next(turning_goals(can, OVERTURNED, []))
    away = np.array([-0.3, 0.6, -0.7])
    T = rolled(can, goal.T_goal_stand, away)
    turned = T[:3, :3] @ away
    assert turned[2] == pytest.approx(np.hypot(0.3, 0.6))
    np.testing.assert_allclose(T[:3, 2], goal.T_goal_stand[:3, 2], atol=1e-12)
    points = can.vertices @ T[:3, :3].T + T[:3, 3]
    assert abs(points[:, 2].min()) < 2e-3
    laid = next(turning_goals(mug, OVERTURNED, [])).T_goal_stand
    assert rolled(mug, laid, away) is laid


def test_a_mug_lies_on_body_and_handle(mug):
    sides = lying_sides(mug)
    handles = [side for side in sides if abs(side[1]) > 0.3]
    assert len(handles) >= 2
    for up in handles[:2]:
        height = mug.vertices @ up
        lowest = mug.vertices[height < height.min() + 1e-6]
        assert lowest[:, 0].max() > 0.05, "the handle touches"
        assert lowest[:, 0].min() < 0.03, "the body touches"


def test_goals_of_an_object_on_its_side_are_upright(can):
    goal = next(turning_goals(can, on_side(), []))
    assert goal.T_goal_stand is None and goal.name == can.name


def test_goals_of_an_overturned_object_lie_on_the_table_over_their_spot(mug):
    goals = list(turning_goals(mug, OVERTURNED, []))[:2]
    for goal in goals:
        points = mug.vertices @ goal.T_goal_stand[:3, :3].T + goal.T_goal_stand[:3, 3]
        assert points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(points[:, :2].min(axis=0), -points[:, :2].max(axis=0), atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(goal.T_goal_stand[:3, :3]), 1.0)
        assert abs(goal.T_goal_stand[2, 2]) < 1e-9, "its axis is level"
    assert not np.allclose(goals[0].T_goal_stand, goals[1].T_goal_stand), "both sides of the handle"


def test_an_object_that_lies_on_no_side_still_has_no_grasp(shapes):
    ball = to_standing(shapes.estimate(1, "bowl", shapes.bowl()))
    found = reorienting_grasps(ball, OVERTURNED)
    assert not found.grasps and sum(found.rejected.values()) > 0


def test_yaw_turns_a_laid_object_about_its_spot(can):
    goal = next(turning_goals(can, OVERTURNED, []))
    turned = pose_from_yaw(1.0, np.array(goal.position)) @ goal.T_goal_stand
    points = can.vertices @ turned[:3, :3].T + turned[:3, 3]
    middle = (points[:, :2].max(axis=0) + points[:, :2].min(axis=0)) / 2
    np.testing.assert_allclose(middle, goal.position[:2], atol=2e-3)
