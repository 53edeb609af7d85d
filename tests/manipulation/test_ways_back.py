"""An object in the hand met something on its way to the goal, and is brought back."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.observation import NoObserver
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import PlanExecution
from manipulation.standing import to_standing
from manipulation.types import Placement
from perception.geometry import pose_from_yaw
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot
from tests.manipulation.test_plan_execution import planner_of


@pytest.fixture(scope="module")
def item(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


@pytest.fixture(scope="module")
def beside(shapes):
    """A can 5 cm beside the first one."""
    return to_standing(shapes.estimate(2, "can", shapes.can(), x=0.5, y=-0.37))


@pytest.fixture(scope="module")
def plan(item, arm):
    return planner_of(item, arm).plan(Placement("can_1", (0.5, 0.1, 0.0), (0.0,)), arm.q_home)


class MeetsSomething(FakeRobot):
    """Stops on the way down to its goal, or to above that, at a share of its samples."""

    before, share = 4, 0.8

    def follow(self, trajectory):
        if len(self.motions) == self.before and self.share:
            self.q = trajectory.positions[int(self.share * len(trajectory.positions))].copy()
            self.share = 0.0
            raise RobotError("the arm is blocked")
        super().follow(trajectory)


def test_an_object_that_meets_something_is_brought_back_in_the_hand(item, arm, plan):
    robot, planner = MeetsSomething(arm, [plan.grasp.held_width]), planner_of(item, arm)
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    up, _, back = robot.motions[4:]
    heights = [Kinematics(arm).forward(q)[2, 3] for q in (up.positions[0], up.positions[-1])]
    assert heights[1] > heights[0] + 0.005
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"
    assert back.duration < plan.carry.duration + plan.lowering.duration + plan.lift.duration
    assert robot.widths == [plan.grasp.opening, 0.0], "the hand stays closed on the way"


class MeetsItAgain(MeetsSomething):
    """Stops again on the way back as it came."""

    again = True

    def follow(self, trajectory):
        if len(self.motions) == 5 and self.again:
            self.again = False
            raise RobotError("the arm is blocked")
        super().follow(trajectory)


def test_where_the_way_back_is_blocked_another_one_is_planned(item, arm, plan):
    robot, planner = MeetsItAgain(arm, [plan.grasp.held_width]), planner_of(item, arm)
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"
    assert len(robot.motions) == 8 and robot.widths == [plan.grasp.opening, 0.0]
    assert planner.scene.world.contact(plan.lift.positions[-1], plan.grasp.held_width) is None, (
        "nothing is carried"
    )


def blocked_beside(item, beside, arm, plan, blocked=(4, 0.8), observer=None):
    """Execute a plan that is blocked, of a can that stands beside another one."""
    robot = MeetsSomething(arm, [plan.grasp.held_width])
    robot.before, robot.share = blocked
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item, "can_2": beside}, config=CONFIG.pick_place)
    execution = PlanExecution(
        robot, planner, observer or FakeObserver(), CONFIG, lambda *args, **options: None
    )
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    return robot, planner


@pytest.mark.parametrize("blocked", [(4, 0.8), (3, 0.6)])
def test_among_others_it_is_set_down_where_there_is_room(item, beside, arm, plan, blocked):
    """It may have turned in the hand, and would knock over what it stood beside."""
    robot, planner = blocked_beside(item, beside, arm, plan, blocked)
    T = planner.scene.pose("can_1")
    reach = np.linalg.norm(item.vertices - plan.grasp.T_stand_tcp[:3, 3], axis=1).max()
    clear = (
        np.linalg.norm(T[:2, 3] - beside.T_world_stand[:2, 3])
        - np.linalg.norm(beside.vertices[:, :2], axis=1).max()
    )
    assert clear > 1.3 * reach - 0.005
    assert T[2, 3] == pytest.approx(0.01, abs=1e-3) and T[2, 2] == pytest.approx(1.0)
    np.testing.assert_allclose(Kinematics(arm).forward(robot.q), T @ plan.grasp.T_stand_tcp, atol=2e-3)
    assert planner.scene.world.contact(robot.motions[-1].positions[0], plan.grasp.held_width) is None, (
        "nothing is carried"
    )


def test_what_stood_on_another_object_is_lowered_to_the_table(item, shapes, arm):
    """Not onto that again, from which it would fall."""
    above = replace(item, T_world_stand=pose_from_yaw(0.0, np.array([0.5, -0.25, item.top + 0.001])))
    below = to_standing(shapes.estimate(2, "can", shapes.can(), x=0.5, y=-0.25))
    both = PickPlacePlanner(Kinematics(arm), {"can_1": above, "can_2": below}, config=CONFIG.pick_place)
    plan = both.plan(Placement("can_1", (0.5, 0.1, 0.0), (0.0,)), arm.q_home)
    _, planner = blocked_beside(above, below, arm, plan, observer=NoObserver())
    T = planner.scene.pose("can_1")
    assert np.linalg.norm((T - above.T_world_stand)[:2, 3]) > 0.05
    assert T[2, 3] == pytest.approx(0.01, abs=1e-3), "lower than before by the height of the other one"


class MeetsTheTable(MeetsSomething):
    """Is blocked once more while an object is lowered to the table."""

    def follow(self, trajectory):
        if len(self.motions) == 6:
            self.q = trajectory.positions[len(trajectory.positions) // 2].copy()
            self.motions.append(trajectory)
            raise RobotError("the arm is blocked")
        super().follow(trajectory)


def test_what_touches_the_table_early_is_left_there(item, beside, arm, plan):
    """It has turned, and reaches further down than expected."""
    robot = MeetsTheTable(arm, [plan.grasp.held_width])
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item, "can_2": beside}, config=CONFIG.pick_place)
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    assert len(robot.motions) == 7, "no further way is tried"
    assert np.linalg.norm((planner.scene.pose("can_1") - item.T_world_stand)[:2, 3]) > 0.05
