"""A bowl that was put into others and leans there, on a robot that follows exactly."""

import contextlib

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manipulation.errors import LeaningError
from manipulation.kinematics import Kinematics
from manipulation.nesting import nest_heights
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import PlanExecution
from manipulation.stack_settling import MAX_PRESSES
from manipulation.standing import to_standing
from manipulation.types import Box, Placement
from perception.geometry import pose_from_yaw
from tests.manipulation.test_execution import CONFIG, FakeObserver, FakeRobot


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


def watched(robot, planner, observer):
    """Return the execution of plans, and the list that its messages are appended to."""
    messages = []

    def notify(phase, name, message="", plan=None):
        messages.append(message)

    return PlanExecution(robot, planner, observer, CONFIG, notify), messages


@pytest.mark.parametrize(
    "looks, presses, leans",
    [
        ((0.0,), 0, False),
        ((0.25, 0.0), 1, False),
        ((0.12,) * 9, MAX_PRESSES, False),
        ((0.25,) * 9, MAX_PRESSES, True),
        ((0.5, 0.0), 1, False),
    ],
)
def test_a_bowl_that_leans_in_another_is_pressed_level_or_placed_again(nested, arm, looks, presses, leans):
    planner, plan = nested
    robot = FakeRobot(arm, [plan.grasp.held_width])
    observer = FakeObserver()
    for angle in looks:
        T = plan.T_world_stand_rest.copy()
        T[:2, 3] += 0.005
        T[:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ T[:3, :3]
        lower = planner.scene.pose("bowl_1").copy()
        lower[0, 3] = Box().center[0] + 0.004
        observer.closer.append({"bowl_2": T, "bowl_1": lower})
    execution, messages = watched(robot, planner, observer)
    expected = pytest.raises(LeaningError, match=r"bowl_2 leans by \d+ degrees in bowl_1")
    with expected if leans else contextlib.nullcontext():
        execution.run(plan)
    assert observer.looked_at == [("bowl_2", "bowl_1")] * (presses + 1)
    assert messages.count("leans and is pressed level") == presses
    if leans:
        np.testing.assert_array_equal(planner.scene.pose("bowl_2"), T)
        return
    # Both bowls are where they were seen, without the tilt and at their heights.
    upper, lower = planner.scene.pose("bowl_2"), planner.scene.pose("bowl_1")
    assert upper[:3, 3] == pytest.approx(plan.T_world_stand_rest[:3, 3] + (0.005, 0.005, 0.0))
    assert upper[2, 2] == pytest.approx(1.0) and lower[0, 3] == pytest.approx(Box().center[0] + 0.004)


def test_a_bowl_that_would_be_levered_out_is_not_pressed(nested, arm):
    """The high side of its rim is beyond that of the bowl below."""
    planner, plan = nested
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    T = plan.T_world_stand_rest.copy()
    T[1, 3] += 0.05
    T[:3, :3] = Rotation.from_euler("x", 0.5).as_matrix() @ T[:3, :3]
    observer.closer = [{"bowl_2": T}]
    execution, messages = watched(robot, planner, observer)
    with pytest.raises(LeaningError, match="bowl_2 leans by 29 degrees in bowl_1"):
        execution.run(plan)
    assert "leans and is pressed level" not in messages


def test_a_bowl_that_went_deeper_than_planned_is_pressed_down_to_there(nested, arm):
    """Between the corners of a polygon: pressed to the planned height, the hand would not reach it."""
    planner, plan = nested
    robot, observer, deeper = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver(), 0.012
    for angle in (0.25, 0.0):
        T = plan.T_world_stand_rest.copy()
        T[2, 3] -= deeper
        T[:3, :3] = Rotation.from_euler("x", angle).as_matrix() @ T[:3, :3]
        observer.closer.append({"bowl_2": T})
    PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None).run(plan)
    height = planner.scene.items["bowl_2"].top + plan.T_world_stand_rest[2, 3] - deeper
    lowest = min(planner.kinematics.forward(m.positions[-1])[2, 3] for m in robot.motions[-2:])
    assert lowest - robot.arm.gripper.tip == pytest.approx(height, abs=0.004)
    assert planner.scene.pose("bowl_2")[2, 3] == pytest.approx(plan.T_world_stand_rest[2, 3] - deeper)


def test_what_is_seen_higher_than_a_bowl_can_lean_is_level(nested, arm):
    """A bowl that was reconstructed too low fits where its rim is, and its errors look like a tilt."""
    planner, plan = nested
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    T = plan.T_world_stand_rest.copy()
    T[2, 3] += 0.02
    T[:3, :3] = Rotation.from_euler("x", 0.12).as_matrix() @ T[:3, :3]
    observer.closer = [{"bowl_2": T, "bowl_1": planner.scene.pose("bowl_1")}]
    execution, messages = watched(robot, planner, observer)
    execution.run(plan)
    assert observer.looked_at == [("bowl_2", "bowl_1")] and "leans and is pressed level" not in messages
    assert planner.scene.pose("bowl_2")[2, 3] == pytest.approx(plan.T_world_stand_rest[2, 3])


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
        planner.scene.moved(bowl.name, pose_from_yaw(0.0, np.array([*Box().center, lift])))
    goal = Placement("bowl_3", (*Box().center, 0.0), (0.0,), ("bowl_1", "bowl_2"), 0.03)
    plan = planner.plan(goal, arm.q_home)
    observer, messages = FakeObserver(), []
    for upper, middle in looks:
        tilted = {"bowl_3": plan.T_world_stand_rest.copy(), "bowl_2": planner.scene.pose("bowl_2").copy()}
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
    n_moves = sum(motion is not None for motion in (plan.transit, plan.settle)) + 5
    robot.blocked_motions = {n_moves + 2}  # after the way to above the point
    PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None).run(plan)
    assert len(observer.looked_at) == 2 and len(robot.motions) == n_moves + 3, "it was backed off"
