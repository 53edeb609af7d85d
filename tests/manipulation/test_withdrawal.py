"""Motions of the hand away from what is around it, on a robot that follows exactly."""

import numpy as np
import pytest

from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.observation import Finding
from manipulation.pick_place import PickPlacePlanner
from manipulation.standing import to_standing
from manipulation.types import Rejected
from manipulation.withdrawal import Withdrawal, WithdrawingObserver, way_out
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot


@pytest.fixture
def planner(shapes, arm):
    item = to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))
    return PickPlacePlanner(Kinematics(arm), {"can_1": item}, config=CONFIG.pick_place)


@pytest.fixture
def among(planner, arm):
    """The robot with its fingers on the can."""
    robot = FakeRobot(arm)
    grasp = planner.scene.grasps("can_1").grasps[0]
    T = planner.scene.pose("can_1") @ grasp.T_stand_tcp
    result = planner.kinematics.inverse(T, planner.kinematics.seeds_toward(T))
    assert result.converged
    robot.q, robot.width = result.q, grasp.held_width
    return robot


def height(planner, robot) -> float:
    return float(planner.kinematics.forward(robot.q)[2, 3])


def test_a_hand_among_objects_is_near_them_until_it_has_left(planner, among):
    world = planner.scene.world
    assert world.touched(among.q, among.width) == {"can_1"}
    line = way_out(planner.motions, among.q, among.width)
    assert line is not None and world.contact(line[-1], among.width) is None
    assert Withdrawal(among, planner).leave()
    assert len(among.motions) == 1 and world.touched(among.q, among.width) == frozenset()
    assert Withdrawal(among, planner).leave() and len(among.motions) == 1, "it is free already"


def test_a_line_through_something_else_is_no_way_out(planner, among, monkeypatch):
    monkeypatch.setattr(planner.motions, "free_line", lambda *_: Rejected("collide with thing_1"))
    assert way_out(planner.motions, among.q, among.width) is None
    assert not Withdrawal(among, planner).leave() and not among.motions


def test_the_hand_rises_above_the_objects_once(planner, among):
    withdrawal = Withdrawal(among, planner)
    assert withdrawal.rise()
    assert height(planner, among) == pytest.approx(planner.motions.via_heights[0], abs=1e-3)
    n_motions = len(among.motions)
    assert withdrawal.rise() and len(among.motions) == n_motions


def test_a_hand_has_risen_only_if_it_was_moved(planner, among, monkeypatch):
    withdrawal = Withdrawal(among, planner)
    assert withdrawal.has_risen() and not withdrawal.has_risen()
    monkeypatch.setattr(withdrawal, "rise", lambda: False)
    assert not withdrawal.has_risen()


def test_where_nothing_is_free_above_the_hand_goes_home_around_it(planner, among, monkeypatch):
    Withdrawal(among, planner).leave()
    monkeypatch.setattr(planner.motions, "free_line", lambda *_: Rejected("out of reach"))
    assert Withdrawal(among, planner).rise()
    assert among.q == pytest.approx(among.arm.q_home)


def test_the_camera_is_not_moved_where_the_hand_cannot_rise(planner, among, monkeypatch):
    seen = FakeObserver(("in_place",), can_1=[Finding("missing")])
    seen.closer = [{"can_1": np.eye(4)}]
    seen.obstacles = [()]
    observer = WithdrawingObserver(seen, Withdrawal(among, planner))
    monkeypatch.setattr(planner.motions, "free_line", lambda *_: Rejected("collide with thing_1"))
    monkeypatch.setattr(planner.motions, "free_path", lambda *_: None)
    assert observer.find("can_1", planner.scene.poses()).status == "unseen"
    assert observer.look_closer(("can_1",), planner.scene.poses()) == {}
    assert observer.find_obstacles(planner.scene.poses()) is None and not among.motions
    assert observer.glance(planner.scene.poses(), ("can_1",)) == {"can_1": "in_place"}, "needs no motion"
    seen.shifted, T_held = np.eye(4), planner.scene.pose("can_1")
    np.testing.assert_array_equal(observer.held("can_1", planner.scene.poses(), T_held), T_held)
    seen.unknown = np.eye(3)
    np.testing.assert_array_equal(
        observer.unexpected(planner.scene.poses(), (), lambda points: points[:, 0] > 0.5), np.eye(3)[:1]
    )
    monkeypatch.undo()
    assert observer.find("can_1", planner.scene.poses()).status == "missing"
    assert list(observer.look_closer(("can_1",), planner.scene.poses())) == ["can_1"]
    assert observer.find_obstacles(planner.scene.poses()) == ()


def test_a_blocked_withdrawal_is_no_error(planner, among):
    def blocked(trajectory):
        raise RobotError("the arm is blocked")

    among.follow = blocked
    assert not Withdrawal(among, planner).leave() and not Withdrawal(among, planner).rise()
