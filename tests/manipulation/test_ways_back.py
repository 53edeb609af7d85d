"""An object in the hand met something on its way to the goal, and is brought back."""

import pytest

from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.plan_execution import PlanExecution
from manipulation.standing import to_standing
from manipulation.types import Placement
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot
from tests.manipulation.test_plan_execution import planner_of


@pytest.fixture(scope="module")
def item(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


@pytest.fixture(scope="module")
def plan(item, arm):
    return planner_of(item, arm).plan(Placement("can_1", (0.5, 0.1, 0.0), (0.0,)), arm.q_home)


class MeetsSomething(FakeRobot):
    """Stops on the way of its transfer, at a share of its samples."""

    share = 0.9

    def follow(self, trajectory):
        if len(self.motions) == 3 and self.share:
            self.q = trajectory.positions[int(self.share * len(trajectory.positions))].copy()
            self.share = 0.0
            raise RobotError("the arm is blocked")
        super().follow(trajectory)


def test_an_object_that_meets_something_is_brought_back_in_the_hand(item, arm, plan):
    robot, planner = MeetsSomething(arm, [plan.grasp.held_width]), planner_of(item, arm)
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    up, _, back = robot.motions[3:]
    heights = [Kinematics(arm).forward(q)[2, 3] for q in (up.positions[0], up.positions[-1])]
    assert heights[1] > heights[0] + 0.005
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"
    assert back.duration < plan.transfer.duration + plan.lift.duration
    assert robot.widths == [plan.grasp.opening, 0.0], "the hand stays closed on the way"


class MeetsItAgain(MeetsSomething):
    """Stops again on the way back along the transfer."""

    again = True

    def follow(self, trajectory):
        if len(self.motions) == 4 and self.again:
            self.again = False
            raise RobotError("the arm is blocked")
        super().follow(trajectory)


def test_where_the_way_back_is_blocked_another_one_is_planned(item, arm, plan):
    robot, planner = MeetsItAgain(arm, [plan.grasp.held_width]), planner_of(item, arm)
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    with pytest.raises(RobotError, match="blocked"):
        execution.run(plan)
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"
    assert len(robot.motions) == 7 and robot.widths == [plan.grasp.opening, 0.0]
    assert planner.world.contact(plan.lift.positions[-1], plan.grasp.held_width) is None, "nothing is carried"
