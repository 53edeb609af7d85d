"""One plan on a robot that follows exactly: the steps, and what each check raises."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manipulation.errors import RobotError
from manipulation.kinematics import Kinematics
from manipulation.nesting import nest_heights
from manipulation.observation import Finding
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import (
    MAX_PRESSES,
    MISPLACED,
    GraspFailedError,
    LeaningError,
    PlanExecution,
    SceneChangedError,
)
from manipulation.standing import to_standing
from manipulation.types import Box, Placement
from manipulation.withdrawal import HOME_MARGINS
from perception.geometry import pose_from_yaw
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot


@pytest.fixture(scope="module")
def item(shapes):
    return to_standing(shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25))


@pytest.fixture(scope="module")
def plan(item, arm):
    return planner_of(item, arm).plan(Placement("can_1", (0.5, 0.1, 0.0), (0.0,)), arm.q_home)


def planner_of(item, arm):
    return PickPlacePlanner(Kinematics(arm), {"can_1": item}, config=CONFIG.pick_place)


@pytest.fixture
def cell(item, arm, plan):
    """A function that returns the robot, the planner, the phases, and an execution with an observer."""

    def build(*presence, closing=None, **findings):
        robot, planner, phases = FakeRobot(arm, closing or [plan.grasp.held_width]), planner_of(item, arm), []
        notify = lambda phase, name, message="", plan=None: phases.append(phase)  # noqa: E731
        observer = FakeObserver(presence, **findings)
        return robot, planner, phases, PlanExecution(robot, planner, observer, CONFIG, notify)

    return build


def test_the_steps_of_a_plan(cell, plan):
    robot, planner, phases, execution = cell()
    execution.run(plan)
    assert phases == ["approach", "grasp", "transfer", "place", "retreat"]
    assert robot.motions == [plan.transit, plan.approach, plan.lift, plan.transfer, plan.retreat]
    assert robot.widths[:2] == [plan.grasp.opening, 0.0]
    np.testing.assert_array_equal(planner.world.pose("can_1"), plan.T_world_stand_rest)


def test_nothing_is_touched_where_the_scene_has_changed(cell, plan, item):
    robot, planner, _, execution = cell("displaced")
    with pytest.raises(SceneChangedError, match="can_1 is not where it was seen before"):
        execution.run(plan)
    assert robot.motions == [plan.transit] and 0.0 not in robot.widths
    np.testing.assert_array_equal(planner.world.pose("can_1"), item.T_world_stand)


@pytest.mark.parametrize("lifted", [(), ("mug_2",)])
def test_what_an_object_stood_in_is_put_back_with_it(shapes, arm, lifted):
    bowl = to_standing(shapes.estimate(1, "bowl", shapes.bowl(0.035, 0.04), 0.5, -0.25))
    mug = to_standing(shapes.estimate(2, "mug", shapes.mug(), 0.5, -0.25))
    beside = to_standing(shapes.estimate(3, "can", shapes.can(), 0.5, 0.0))
    raised = bowl.T_world_stand.copy()
    raised[2, 3] = 0.09
    bowl = replace(bowl, T_world_stand=raised)
    items = {item.name: item for item in (bowl, mug, beside)}
    planner = PickPlacePlanner(Kinematics(arm), items, config=CONFIG.pick_place)
    plan = planner.plan(Placement("bowl_1", (0.5, 0.25, 0.0), (0.0,)), arm.q_home)
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    observer.lifted = lifted
    execution = PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None)
    if not lifted:
        execution.run(plan, looks_first=False)
        return
    with pytest.raises(GraspFailedError, match="mug_2 was lifted with bowl_1"):
        execution.run(plan, looks_first=False)
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"
    np.testing.assert_array_equal(planner.world.pose("bowl_1"), raised)


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


@pytest.mark.parametrize("side", [0, 1])
def test_widths_outside_the_range_are_no_grasp(cell, plan, side):
    width = plan.grasp.closed_width[side] + (2 * side - 1) * 0.0005
    robot, _, phases, execution = cell(closing=[width])
    with pytest.raises(GraspFailedError, match="no object between the fingers after closing on can_1"):
        execution.run(plan)
    assert phases == ["approach", "grasp"]
    height = Kinematics(robot.arm).forward(robot.q)[2, 3]
    execution.back_off()
    assert robot.widths[-1] == robot.arm.max_width
    assert Kinematics(robot.arm).forward(robot.q)[2, 3] - height == pytest.approx(0.15, abs=1e-3)


@pytest.mark.parametrize("shift, raises", [(MISPLACED + 0.002, True), (MISPLACED - 0.002, False)])
def test_an_object_seen_beside_its_goal(cell, plan, shift, raises):
    seen = plan.T_world_stand_rest.copy()
    seen[0, 3] += shift
    _, planner, _, execution = cell("in_place", "displaced", can_1=[Finding("found", seen)])
    if raises:
        with pytest.raises(GraspFailedError, match="can_1 is not where it was released"):
            execution.run(plan)
    else:
        execution.run(plan)
    np.testing.assert_array_equal(planner.world.pose("can_1"), seen)


@pytest.mark.parametrize(
    ("category", "turn", "raises"), [("mug", 0.3, True), ("mug", 0.1, False), ("can", 0.3, False)]
)
def test_a_mug_that_was_turned_when_it_was_released(cell, plan, category, turn, raises):
    """Handles are aligned; the yaw of a can is unknown."""
    seen = plan.T_world_stand_rest @ pose_from_yaw(turn, np.zeros(3))
    _, planner, _, execution = cell("in_place", "displaced", can_1=[Finding("found", seen)])
    planner.items["can_1"] = replace(planner.items["can_1"], category=category)
    if raises:
        with pytest.raises(GraspFailedError, match="can_1 was turned when it was released"):
            execution.run(plan)
    else:
        execution.run(plan)
    np.testing.assert_array_equal(planner.world.pose("can_1"), seen)


@pytest.fixture(scope="module")
def nested(shapes, arm):
    """Two bowls and the plan that puts the smaller one into the larger one, which is in the box."""
    bowls = [
        to_standing(shapes.estimate(1, "bowl", shapes.bowl(0.075, 0.06), *Box().center)),
        to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.06, 0.045), 0.5, -0.25)),
    ]
    planner = PickPlacePlanner(
        Kinematics(arm),
        {bowl.name: bowl for bowl in bowls},
        (TABLE, *box_obstacles(Box())),
        CONFIG.pick_place,
    )
    goal = Placement("bowl_2", (*Box().center, 0.0), (0.0,), ("bowl_1",), 0.01)
    return planner, planner.plan(goal, arm.q_home)


@pytest.mark.parametrize(
    "looks, presses, leans",
    [
        ((0.0,), 0, False),
        ((0.25, 0.0), 1, False),
        ((0.12,) * 9, MAX_PRESSES, False),
        ((0.25,) * 9, MAX_PRESSES, True),
        ((0.4,), 0, True),
    ],
)
def test_a_bowl_that_leans_in_another_is_pressed_level_or_placed_again(nested, arm, looks, presses, leans):
    planner, plan = nested
    robot, messages = FakeRobot(arm, [plan.grasp.held_width]), []
    observer = FakeObserver()
    for angle in looks:
        T = plan.T_world_stand_rest.copy()
        T[:2, 3] += 0.005
        T[:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ T[:3, :3]
        lower = planner.world.pose("bowl_1").copy()
        lower[0, 3] = Box().center[0] + 0.004
        observer.closer.append({"bowl_2": T, "bowl_1": lower})
    execution = PlanExecution(
        robot, planner, observer, CONFIG, lambda phase, name, message="", plan=None: messages.append(message)
    )
    expected = pytest.raises(LeaningError, match=r"bowl_2 leans by \d+ degrees in bowl_1")
    with expected if leans else contextlib.nullcontext():
        execution.run(plan)
    assert observer.looked_at == [("bowl_2", "bowl_1")] * (presses + 1)
    assert messages.count("leans and is pressed level") == presses
    if leans:
        np.testing.assert_array_equal(planner.world.pose("bowl_2"), T)
        return
    # Both bowls are where they were seen, without the tilt and at their heights.
    upper, lower = planner.world.pose("bowl_2"), planner.world.pose("bowl_1")
    assert upper[:3, 3] == pytest.approx(plan.T_world_stand_rest[:3, 3] + (0.005, 0.005, 0.0))
    assert upper[2, 2] == pytest.approx(1.0) and lower[0, 3] == pytest.approx(Box().center[0] + 0.004)


@pytest.mark.parametrize(
    ("looks", "pressed", "leans"),
    [
        # Pressed level, the upper one pushes that below it aside: both are tried once, then it is taken out.
        (((0.25, 0.0), (0.0, 0.25), (0.25, 0.0)), ["bowl_3", "bowl_2"], True),
        (((0.25, 0.25), (0.12, 0.0), (0.0, 0.0)), ["bowl_2", "bowl_3"], False),
        (((0.0, 0.25), (0.0, 0.0)), ["bowl_2"], False),
    ],
)
def test_in_a_stack_of_three_the_lower_one_that_leans_is_pressed_first(shapes, arm, looks, pressed, leans):
    sizes = ((0.09, 0.07), (0.075, 0.05), (0.06, 0.035))
    places = (Box().center, Box().center, (0.5, -0.25))
    bowls = [
        to_standing(shapes.estimate(i, "bowl", shapes.bowl(*size, slope=0.3), *place))
        for i, (size, place) in enumerate(zip(sizes, places, strict=True), 1)
    ]
    obstacles = (TABLE, *box_obstacles(Box()))
    planner = PickPlacePlanner(Kinematics(arm), {b.name: b for b in bowls}, obstacles, CONFIG.pick_place)
    for bowl, lift in zip(bowls, nest_heights(bowls[:2]), strict=False):
        planner.moved(bowl.name, pose_from_yaw(0.0, np.array([*Box().center, lift])))
    goal = Placement("bowl_3", (*Box().center, 0.0), (0.0,), ("bowl_1", "bowl_2"), 0.03)
    plan = planner.plan(goal, arm.q_home)
    observer, messages = FakeObserver(), []
    for upper, middle in looks:
        tilted = {"bowl_3": plan.T_world_stand_rest.copy(), "bowl_2": planner.world.pose("bowl_2").copy()}
        for name, angle in (("bowl_3", upper), ("bowl_2", middle)):
            tilted[name][:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ tilted[name][:3, :3]
        observer.closer.append(tilted)

    def notify(phase, name, message="", plan=None):
        messages.extend([name] if "pressed" in message else [])

    execution = PlanExecution(FakeRobot(arm, [plan.grasp.held_width]), planner, observer, CONFIG, notify)
    expected = pytest.raises(LeaningError, match="bowl_3 leans") if leans else contextlib.nullcontext()
    with expected:
        execution.run(plan)
    assert messages == pressed


def test_a_bowl_that_gives_no_further_does_not_stop_the_robot(nested, arm):
    planner, plan = nested
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    T = plan.T_world_stand_rest.copy()
    T[:3, :3] = Rotation.from_euler("x", 0.25).as_matrix() @ T[:3, :3]
    observer.closer = [{"bowl_2": T}]
    n_moves = sum(motion is not None for motion in (plan.transit, plan.settle)) + 4
    robot.blocked_motions = {n_moves + 2}  # after the way to above the point
    PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None).run(plan)
    assert len(observer.looked_at) == 2 and len(robot.motions) == n_moves + 3, "it was backed off"


def test_home_is_reached_and_a_blocked_way_home_is_no_error(cell):
    robot, _, _, execution = cell()
    home = robot.arm.q_home
    execution.go_home()
    assert not robot.motions, "it is there"
    robot.q = home + np.array([0.3, 0, 0, 0, 0, 0, 0])
    execution.go_home()
    assert robot.q == pytest.approx(home)
    robot.q = home + np.array([0.3, 0, 0, 0, 0, 0, 0])
    robot.follow = lambda trajectory: (_ for _ in ()).throw(RobotError("blocked"))
    execution.go_home()


def test_where_no_way_home_is_known_to_be_free_it_leads_over_a_point_above_the_hand(cell, monkeypatch):
    """The direct way would sweep the table: it toppled a carton beside the forearm."""
    robot, planner, _, execution = cell()
    low = planner.kinematics.forward(robot.arm.q_home)
    low[2, 3] = 0.12
    robot.q = planner.kinematics.inverse(low, [robot.arm.q_home], name="").q
    before, margins = len(robot.motions), []
    monkeypatch.setattr(planner.motions, "free_path", lambda q, home, width, m: margins.append(m))
    execution.go_home()
    first, second = robot.motions[before:]
    assert planner.kinematics.forward(first.positions[-1])[2, 3] > 0.2
    assert second.positions[-1] == pytest.approx(robot.arm.q_home)
    assert margins == [(None, *HOME_MARGINS)], "narrow ways are tried before"
