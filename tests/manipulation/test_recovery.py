"""Motions after a failure on a robot that follows exactly: backing off, and the way home."""

import numpy as np
import pytest

from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.pick_place import PickPlacePlanner
from manipulation.recovery import Recovery
from manipulation.standing import to_standing
from manipulation.types import Placement
from manipulation.withdrawal import HOME_MARGINS
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot


@pytest.fixture(scope="module")
def planner(shapes, arm):
    item = to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))
    return PickPlacePlanner(Kinematics(arm), {"can_1": item}, config=CONFIG.pick_place)


@pytest.fixture(scope="module")
def plan(planner, arm):
    return planner.plan(Placement("can_1", (0.5, 0.1, 0.0), (0.0,)), arm.q_home)


@pytest.fixture
def cell(planner, arm, plan):
    """A robot, its observer, and its recovery."""
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    return robot, observer, Recovery(robot, planner, observer, CONFIG)


def test_a_failed_grasp_ends_with_the_fingers_as_before_it_and_the_hand_above(cell, plan):
    robot, _, recovery = cell
    robot.q = plan.approach.positions[-1].copy()
    height = Kinematics(robot.arm).forward(robot.q)[2, 3]
    recovery.back_off(plan.grasp)
    assert robot.widths == [plan.grasp.opening]
    assert Kinematics(robot.arm).forward(robot.q)[2, 3] - height == pytest.approx(0.15, abs=1e-3)


@pytest.mark.parametrize(("offset", "hangs"), [(0.03, True), (0.09, False)])
def test_what_hangs_on_the_fingers_is_put_down_and_let_go(cell, plan, offset, hangs):
    """A bowl that a finger jams would be carried about by the camera's next motion."""
    robot, observer, recovery = cell
    robot.q = plan.approach.positions[-1].copy()
    before, n_before = robot.q, len(robot.motions)
    T = Kinematics(robot.arm).forward(before)
    raised = T[:3, 3] + (0.0, 0.0, 0.15 - offset)
    observer.unknown = raised + np.random.default_rng(0).uniform(-0.003, 0.003, (100, 3))
    recovery.back_off(plan.grasp)
    assert len(robot.motions) - n_before == (3 if hangs else 1)
    if hangs:
        assert robot.motions[-2].positions[-1] == pytest.approx(before)
        held, opening = plan.grasp.held_width, plan.grasp.opening
        assert robot.widths[-2:] == [opening, pytest.approx(0.5 * (held + opening))]
    assert Kinematics(robot.arm).forward(robot.q)[2, 3] - T[2, 3] == pytest.approx(0.15, abs=1e-3)


def test_a_closed_hand_stays_closed_when_it_backs_off(cell, plan):
    """It pushed or pressed: among objects, or in a bowl, there is no room to open."""
    robot, observer, recovery = cell
    robot.q = plan.approach.positions[-1].copy()
    observer.unknown = np.full((100, 3), 0.5)
    recovery.back_off()
    assert robot.widths == [] and len(robot.motions) == 1


def test_home_is_reached_and_a_blocked_way_home_is_no_error(cell):
    robot, _, recovery = cell
    home = robot.arm.q_home
    recovery.go_home()
    assert not robot.motions, "it is there"
    robot.q = home + np.array([0.3, 0, 0, 0, 0, 0, 0])
    recovery.go_home()
    assert robot.q == pytest.approx(home)
    robot.q = home + np.array([0.3, 0, 0, 0, 0, 0, 0])
    robot.follow = lambda trajectory: (_ for _ in ()).throw(RobotError("blocked"))
    recovery.go_home()


def test_where_no_way_home_is_known_to_be_free_it_leads_over_a_point_above_the_hand(
    cell, planner, monkeypatch
):
    """The direct way would sweep the table: it toppled a carton beside the forearm."""
    robot, _, recovery = cell
    low = planner.kinematics.forward(robot.arm.q_home)
    low[2, 3] = 0.12
    robot.q = planner.kinematics.inverse(low, [robot.arm.q_home], name="").q
    before, margins = len(robot.motions), []
    monkeypatch.setattr(planner.motions, "any_path", lambda q, home, width, m: margins.append(m))
    recovery.go_home()
    first, second = robot.motions[before:]
    assert planner.kinematics.forward(first.positions[-1])[2, 3] > 0.2
    assert second.positions[-1] == pytest.approx(robot.arm.q_home)
    assert margins == [(None, *HOME_MARGINS)], "narrow ways are tried before"
