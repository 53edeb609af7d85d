"""One plan on a robot that follows exactly: the steps, and what each check raises."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import (
    ApproachBlockedError,
    GoalBlockedError,
    GraspFailedError,
    RobotError,
    SceneChangedError,
    UnknownInTheWayError,
)
from manipulation.kinematics import Kinematics
from manipulation.observation import Finding
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place import PickPlacePlanner
from manipulation.plan_execution import MISPLACED, OFF_ROW, PlanExecution
from manipulation.standing import to_standing
from manipulation.types import Placement
from perception.geometry import invert, pose_from_yaw, so3_exp
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
    assert robot.motions == [
        plan.transit, plan.approach, plan.lift, plan.carry, plan.lowering, plan.retreat,
    ]  # fmt: skip
    assert robot.widths[:2] == [plan.grasp.opening, 0.0]
    np.testing.assert_array_equal(planner.scene.pose("can_1"), plan.T_world_stand_rest)


def test_nothing_is_touched_where_the_scene_has_changed(cell, plan, item):
    robot, planner, _, execution = cell("displaced")
    with pytest.raises(SceneChangedError, match="can_1 is not where it was seen before"):
        execution.run(plan)
    assert robot.motions == [plan.transit] and 0.0 not in robot.widths
    np.testing.assert_array_equal(planner.scene.pose("can_1"), item.T_world_stand)


@pytest.mark.parametrize(
    ("where", "is_free"),
    [("above", False), ("beside", True), ("in a finger", False), ("few points above", True)],
)
def test_the_hand_does_not_go_where_something_unknown_is(shapes, item, arm, plan, where, is_free):
    """A neck that the estimate of the can lacks, in the way of the palm; what is beside that is not."""
    T_grasp = Kinematics(arm).forward(plan.approach.positions[-1])
    finger = plan.grasp.opening / 2 + 0.008
    offset = {"beside": (0.05, 0.0, -0.02), "in a finger": (0.0, finger, 0.0)}.get(where, (0, 0, -0.06))
    middle = T_grasp[:3, :3] @ np.array(offset) + T_grasp[:3, 3]
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    count = 20 if where.startswith("few") else 100
    observer.unknown = middle + np.random.default_rng(0).uniform(-0.003, 0.003, (count, 3))
    planner = planner_of(item, arm)
    execution = PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None)
    if is_free:
        execution.run(plan)
        return
    with pytest.raises(
        UnknownInTheWayError, match=r"something unknown at .* is in the way of the hand to can_1"
    ):
        execution.run(plan)
    assert robot.motions == [plan.transit] and 0.0 not in robot.widths


@pytest.mark.parametrize(
    ("number", "error"), [(1, ApproachBlockedError), (2, ApproachBlockedError), (3, RobotError)]
)
def test_what_blocks_the_hand_before_it_is_at_the_object(cell, plan, number, error):
    """Transit and approach, but not the lift."""
    robot, _, _, execution = cell()
    robot.blocked_motions = {number}
    with pytest.raises(RobotError, match="joint4") as raised:
        execution.run(plan)
    assert type(raised.value) is error


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
    np.testing.assert_array_equal(planner.scene.pose("bowl_1"), raised)


@pytest.mark.parametrize(
    ("offset", "count", "is_raised"),
    [
        ((0.0, 0.07, 0.01), 1500, True),
        ((0.0, 0.07, 0.01), 500, False),
        ((0.0, 0.0, -0.04), 1500, True),
        ((0.0, 0.0, -0.08), 1500, False),
        ((0.03, 0.09, 0.18), 1500, True),
        ((0.0, 0.04, 0.05), 1500, False),
        ((0.0, 0.01, 0.05), 1500, False),
        ((0.0, 0.3, 0.01), 1500, False),
        ("in a finger", 1500, False),
    ],
    ids=[
        "beside",
        "few",
        "below",
        "far below",
        "above",
        "nearly its own",
        "inside",
        "far beside",
        "of the hand",
    ],
)
@pytest.mark.parametrize("shifted", [0.0, 0.04])
def test_what_reaches_beyond_its_shape_in_the_hand_is_put_back(
    item, plan, arm, shapes, offset, count, is_raised, shifted
):
    """Relative to its pose in the hand as it is seen; it stood in a bowl."""
    bowl = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.08, 0.04), 0.5, -0.25))
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item, "bowl_2": bowl}, config=CONFIG.pick_place)
    robot = FakeRobot(arm, [plan.grasp.held_width])
    execution = PlanExecution(robot, planner, FakeObserver(), CONFIG, lambda *args, **options: None)
    forward, observer = planner.kinematics.forward, execution.observer
    risen = (forward(plan.lift.positions[-1]) - forward(plan.lift.positions[0]))[:3, 3]
    place = item.T_world_stand[:3, 3] + risen + (shifted, 0.0, 0.0)
    T_tcp = forward(plan.lift.positions[-1])
    in_finger = T_tcp[:3, 3] + T_tcp[:3, :3] @ (0.0, plan.grasp.held_width / 2 + 0.03, -0.035)
    point = in_finger if offset == "in a finger" else place + offset
    observer.shifted = shift_in_world(shifted, 0.0, np.zeros(3))
    unexpected = observer.unexpected

    def beyond(poses, obstacles, region):
        if poses["can_1"][2, 3] < risen[2] / 2:  # on the way to it
            return unexpected(poses, obstacles, region)
        np.testing.assert_allclose(poses["can_1"][:3, 3], place, atol=2e-3)
        points = np.repeat([point], count, axis=0)
        return points[region(points)]

    observer.unexpected = beyond
    if not is_raised:
        execution.run(plan, looks_first=False)
        return
    with pytest.raises(UnknownInTheWayError, match=r"can_1 reaches beyond its shape in the hand, to \(0\.5"):
        execution.run(plan, looks_first=False)
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"


@pytest.mark.parametrize(("below", "is_seen"), [(False, True), (True, False)])
def test_what_stood_on_the_table_or_is_not_seen_in_the_hand_is_not_put_back(
    item, plan, arm, shapes, below, is_seen
):
    bowl = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.08, 0.04), 0.5 if below else 0.1, -0.25))
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item, "bowl_2": bowl}, config=CONFIG.pick_place)
    observer, forward = FakeObserver(), planner.kinematics.forward
    observer.shifted = np.eye(4) if is_seen else None
    risen = (forward(plan.lift.positions[-1]) - forward(plan.lift.positions[0]))[:3, 3]
    beside = item.T_world_stand[:3, 3] + risen + (0.0, 0.07, 0.01)
    observer.unknown = np.repeat([beside], 1500, axis=0)
    robot = FakeRobot(arm, [plan.grasp.held_width])
    execution = PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None)
    execution.run(plan, looks_first=False)
    assert robot.motions[3:5] == [plan.carry, plan.lowering]


@pytest.mark.parametrize(
    ("category", "x", "is_asked"), [("bowl", 0.51, True), ("mug", 0.55, False), ("bowl", 0.35, False)]
)
def test_a_bowl_carries_what_is_estimated_to_stand_as_low(item, plan, arm, shapes, category, x, is_asked):
    """Not what stands beside it, nor a mug what is within the reach of its handle."""
    mesh = shapes.bowl(0.08, 0.04) if category == "bowl" else shapes.mug()
    other = to_standing(shapes.estimate(2, category, mesh, x, -0.25))
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item, other.name: other}, config=CONFIG.pick_place)
    looked = []

    class Observer(FakeObserver):
        def glance(self, poses, names):
            looked.append(tuple(names))
            return {}

    robot = FakeRobot(arm, [plan.grasp.held_width])
    execution = PlanExecution(robot, planner, Observer(), CONFIG, lambda *args, **options: None)
    execution.run(plan, looks_first=False)
    assert ((other.name,) in looked) is is_asked


@pytest.mark.parametrize("side", [0, 1])
def test_widths_outside_the_range_are_no_grasp(cell, plan, side):
    width = plan.grasp.closed_width[side] + (2 * side - 1) * 0.0005
    _, _, phases, execution = cell(closing=[width])
    with pytest.raises(GraspFailedError, match="no object between the fingers after closing on can_1"):
        execution.run(plan)
    assert phases == ["approach", "grasp"]


@pytest.mark.parametrize("slip, raises", [(0.006, True), (0.004, False)])
def test_an_object_that_slips_during_the_lift_is_put_down_again(cell, plan, slip, raises):
    """Both widths are within those at which the object is held."""
    low, high = plan.grasp.closed_width
    assert high - low > 0.008
    robot, _, phases, execution = cell(closing=[low + 0.007])
    robot.slipping = (3, slip)  # transit, approach, lift
    if not raises:
        execution.run(plan)
        return
    with pytest.raises(GraspFailedError, match=r"can_1 slips between the fingers \(6 mm in the lift\)"):
        execution.run(plan)
    assert phases == ["approach", "grasp"]
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"


@pytest.mark.parametrize("misplaced", [MISPLACED, OFF_ROW])
@pytest.mark.parametrize("beyond, raises", [(0.002, True), (-0.002, False)])
def test_an_object_seen_beside_its_goal(cell, plan, misplaced, beyond, raises):
    seen = plan.T_world_stand_rest.copy()
    seen[0, 3] += misplaced + beyond
    _, planner, _, execution = cell("in_place", "displaced", can_1=[Finding("found", seen)])
    assert execution.misplaced == MISPLACED, "unless it is given"
    execution.misplaced = misplaced
    if raises:
        with pytest.raises(GraspFailedError, match="can_1 is not where it was released"):
            execution.run(plan)
    else:
        execution.run(plan)
    np.testing.assert_array_equal(planner.scene.pose("can_1"), seen)


@pytest.mark.parametrize(
    ("category", "turn", "raises"), [("mug", 0.3, True), ("mug", 0.1, False), ("can", 0.3, False)]
)
def test_a_mug_that_was_turned_when_it_was_released(cell, plan, category, turn, raises):
    """Handles are aligned; the yaw of a can is unknown."""
    seen = plan.T_world_stand_rest @ pose_from_yaw(turn, np.zeros(3))
    _, planner, _, execution = cell("in_place", "displaced", can_1=[Finding("found", seen)])
    planner.scene.items["can_1"] = replace(planner.scene.items["can_1"], category=category)
    if raises:
        with pytest.raises(GraspFailedError, match="can_1 was turned when it was released"):
            execution.run(plan)
    else:
        execution.run(plan)
    np.testing.assert_array_equal(planner.scene.pose("can_1"), seen)


def shift_in_world(x, tilt, about):
    """A shift along x [m] with a tilt about y [rad] through a point."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array([0.0, tilt, 0.0]))
    T[:3, 3] = about - T[:3, :3] @ about + (x, 0.0, 0.0)
    return T


@pytest.mark.parametrize(("x", "degrees"), [(0.009, 0.0), (0.0, 8.0), (-0.01, -7.0)])
@pytest.mark.parametrize("look", [0, 1], ids=["in the lift", "on the way"])
def test_an_object_that_has_shifted_in_the_hand_arrives_as_planned(cell, plan, x, degrees, look):
    """The hand arrives beside where it was planned."""
    robot, planner, _, execution = cell()
    robot.joint_positions = lambda: robot.q + 2e-4  # as servos leave it
    forward, observer = planner.kinematics.forward, execution.observer
    T_stand_tcp = plan.grasp.T_stand_tcp
    begin = forward((plan.lift, plan.carry)[look].positions[-1])
    shift = shift_in_world(x, np.deg2rad(degrees), begin[:3, 3])
    T_tcp_stand = invert(begin) @ shift @ begin @ invert(T_stand_tcp)
    looks = []

    def held(name, poses, T_world_tcp):
        looks.append((poses[name], T_world_tcp))
        return T_world_tcp @ T_tcp_stand if len(looks) > look else None

    observer.held = held
    execution.run(plan)
    *moves, lowering = robot.motions[3:-1]
    assert len(looks) == 2 and len(moves) == 1 + look
    assert (moves[0] is plan.carry) == (look == 1)
    np.testing.assert_allclose(looks[look][1], begin, atol=1e-3)
    np.testing.assert_allclose(looks[look][0] @ T_stand_tcp, begin, atol=1e-3)
    released = forward(lowering.positions[-1]) @ T_tcp_stand
    np.testing.assert_allclose(released, plan.T_world_stand_goal, atol=2e-3)
    np.testing.assert_array_equal(planner.scene.pose("can_1"), plan.T_world_stand_rest)
    assert planner.scene.world.contact(plan.carry.positions[-1], plan.grasp.held_width) is None, (
        "none carried"
    )


def test_what_meets_something_after_another_way_is_brought_back_the_way_it_came(cell, plan):
    robot, _, _, execution = cell()
    looks = []

    def held(name, poses, T_world_tcp):
        looks.append(name)
        return shift_in_world(0.009, 0.0, np.zeros(3)) @ poses[name] if len(looks) == 2 else None

    execution.observer.held = held
    robot.blocked_motions = {6}  # transit, approach, lift, carry, another way, down
    with pytest.raises(GoalBlockedError, match="joint4"):
        execution.run(plan)
    assert robot.q == pytest.approx(plan.lift.positions[0]), "where it was grasped"


@pytest.mark.parametrize(("x", "degrees"), [(0.005, 0.0), (0.0, 5.0), (None, None)])
def test_an_object_that_is_held_as_planned_or_not_seen_goes_as_planned(cell, plan, x, degrees):
    robot, planner, _, execution = cell()
    if x is not None:
        about = planner.kinematics.forward(plan.carry.positions[-1]) @ invert(plan.grasp.T_stand_tcp)
        shift = shift_in_world(x, np.deg2rad(degrees), about[:3, 3])
        T_tcp_stand = invert(about @ plan.grasp.T_stand_tcp) @ shift @ about
        execution.observer.held = lambda name, poses, T_world_tcp: T_world_tcp @ T_tcp_stand
    execution.run(plan)
    assert robot.motions[3:5] == [plan.carry, plan.lowering]


def test_an_object_that_has_shifted_goes_as_planned_where_no_other_way_is_free(item, arm, plan):
    x, y = plan.T_world_stand_goal[:2, 3]
    there = Obstacle("there", (x, y, 0.02), (0.02, 0.02, 0.02))
    planner = PickPlacePlanner(Kinematics(arm), {"can_1": item}, (TABLE, there), CONFIG.pick_place)
    robot, observer = FakeRobot(arm, [plan.grasp.held_width]), FakeObserver()
    observer.shifted = shift_in_world(0.01, 0.0, np.zeros(3))
    PlanExecution(robot, planner, observer, CONFIG, lambda *args, **options: None).run(plan)
    assert robot.motions[3:5] == [plan.carry, plan.lowering]
