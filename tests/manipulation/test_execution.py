import itertools
import threading
from dataclasses import replace

import numpy as np
import pytest

from manipulation import execution, object_planning
from manipulation.clearing import MAX_PUSHES
from manipulation.collision import AllowedContacts
from manipulation.errors import NoPlanError, PlanningError, RobotError, RobotStoppedError
from manipulation.execution import execute
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import Kinematics
from manipulation.observation import Finding
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.packing_problem import PackingConfig
from manipulation.pick_place import PickPlaceConfig, PickPlacePlanner
from manipulation.plan_execution import MISPLACED, OFF_ROW, PlanExecution
from manipulation.planner import ManipulationConfig, plan_pack, plan_sort
from manipulation.pushing import Push
from manipulation.robot import RobotState
from manipulation.stack_settling import MAX_PRESSES
from manipulation.standing import to_standing
from manipulation.task_progress import TaskProgress
from manipulation.trajectories import MotionConfig, joint_move
from manipulation.types import Box, Line, Placement
from perception.geometry import pose_from_yaw, so3_exp
from perception.obstacles.obstacle import PerceivedObstacle

# Coarser than the defaults, for speed alone.
CONFIG = ManipulationConfig(
    pick_place=PickPlaceConfig(
        max_plans=1,
        motion=MotionConfig(line_step=0.03),
        grasp=GraspConfig(n_azimuths=8, top_depths=(0.02, 0.03)),
    ),
    packing=PackingConfig(gaps=(0.012,), n_handle_directions=2),
)


class FakeRobot:
    """Follows every motion exactly; ``closing`` lists the widths at which the gripper closes.

    During the motion of number ``slipping[0]`` the closed fingers come ``slipping[1]`` metres nearer.
    """

    def __init__(self, arm, closing=()):
        self.arm = arm
        self.q = np.array(arm.q_home)
        self.width = arm.max_width
        self.closing = list(closing)
        self.expected = 0.01
        self.blocked_motions = set()
        self.slipping = (0, 0.0)
        self.motions = []
        self.widths = []

    def state(self):
        return RobotState(0.0, self.joint_positions(), self.gripper_width())

    def stop(self, reason):
        raise AssertionError(reason)

    def joint_positions(self):
        return self.q.copy()

    def gripper_width(self):
        return self.width

    def follow(self, trajectory):
        assert np.abs(trajectory.positions[0] - self.q).max() < 1e-3, "motions must chain"
        self.motions.append(trajectory)
        if len(self.motions) in self.blocked_motions:
            raise RobotError("the arm is blocked: joint4")
        self.q = trajectory.positions[-1].copy()
        if len(self.motions) == self.slipping[0]:
            self.width -= self.slipping[1]

    def move_gripper(self, width):
        assert 0 <= width <= self.arm.max_width
        self.widths.append(width)
        closes = width == 0
        self.width = (self.closing.pop(0) if self.closing else self.expected) if closes else width
        return self.width

    def capture(self):
        raise NotImplementedError


class Watcher:
    """Collects events and sets the width at which the fake gripper closes on the object."""

    def __init__(self, robot):
        self.robot, self.events = robot, []

    def __call__(self, event):
        self.events.append(event)
        if event.plan is not None:
            self.robot.expected = event.plan.grasp.held_width

    def phases(self, name):
        return [event.phase for event in self.events if event.name == name]

    @property
    def plans(self):
        return {event.name: event.plan for event in self.events if event.plan is not None}


@pytest.fixture(scope="module")
def scene(shapes):
    return [
        shapes.estimate(1, "can", shapes.can(), x=0.55, y=-0.2),
        shapes.estimate(2, "bowl", shapes.bowl(), x=0.4, y=-0.15),
        shapes.estimate(3, "bowl", shapes.bowl(0.06, 0.045), x=0.56, y=-0.38),
    ]


@pytest.fixture(scope="module")
def packing(scene, arm):
    return plan_pack(scene, Box(), arm, CONFIG)


def test_the_arm_may_stay_above_the_objects_at_the_end(packing, arm):
    robot = FakeRobot(arm)
    execute(packing, robot, on_event=Watcher(robot), config=CONFIG, ends_home=False)
    assert np.abs(robot.q - arm.q_home).max() > 0.1
    height = Kinematics(arm).forward(robot.q)[2, 3]
    assert height >= CONFIG.pick_place.via_heights[0] - 2e-3


def test_all_objects_are_placed_at_their_goals(packing, arm):
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(packing, robot, on_event=watcher, config=CONFIG)
    assert [outcome.placed for outcome in outcomes] == [True] * 3
    assert {outcome.attempts for outcome in outcomes} == {1}
    assert robot.q == pytest.approx(arm.q_home)
    goals = {placement.name: placement for placement in packing.placements}
    kinematics = Kinematics(arm)
    for outcome in outcomes:
        assert outcome.T_world_stand[:2, 3] == pytest.approx(goals[outcome.name].position[:2])
        plan = watcher.plans[outcome.name]
        T_tcp = plan.T_world_stand_goal @ plan.grasp.T_stand_tcp
        assert kinematics.forward(plan.lowering.positions[-1]) == pytest.approx(T_tcp, abs=2e-3)
        assert plan.duration > 2
        assert (plan.settle is not None) == (outcome.name == "bowl_2"), (
            "a bowl on the floor may hang on a pad"
        )
        if plan.settle is not None:
            sunk = T_tcp.copy()
            sunk[2, 3] -= CONFIG.pick_place.segments.settle_depth
            assert kinematics.forward(plan.settle.positions[-1]) == pytest.approx(sunk, abs=2e-3)
            assert plan.retreat.positions[0] == pytest.approx(plan.settle.positions[-1])
    phases = ["plan", "approach", "grasp", "transfer", "place", "retreat", "placed"]
    assert watcher.phases("can_1") == phases
    assert outcomes[1].T_world_stand[2, 3] > outcomes[0].T_world_stand[2, 3], "nested bowl stands higher"


def plans_here(monkeypatch):
    """Record the names of the objects that are planned in the thread of the execution."""
    names, plan = [], object_planning.ObjectPlanning.next_plan

    def recorded(self, placement, *args):
        if threading.current_thread() is threading.main_thread():
            names.append(placement.name)
        return plan(self, placement, *args)

    monkeypatch.setattr(object_planning.ObjectPlanning, "next_plan", recorded)
    return names


def test_all_but_the_first_are_planned_while_the_arm_moves(packing, arm, monkeypatch):
    """The third is a bowl that goes into the second, where that one was released."""
    robot, names = FakeRobot(arm), plans_here(monkeypatch)
    outcomes = execute(packing, robot, on_event=Watcher(robot), config=CONFIG)
    assert all(outcome.placed for outcome in outcomes)
    assert names == [packing.placements[0].name]


def test_what_is_not_as_expected_is_planned_again(packing, arm, monkeypatch):
    """The first grasp fails, and the stack of bowls is looked at from elsewhere before the last object."""
    robot, names = FakeRobot(arm, closing=[0.0]), plans_here(monkeypatch)
    execute(packing, robot, FakeObserver(), Watcher(robot), CONFIG)
    first, _, last = (placement.name for placement in packing.placements)
    assert names == [first, first, last]


def test_motions_are_free_of_contact_in_the_planners_world(packing, arm):
    planner = PickPlacePlanner(
        Kinematics(arm), packing.objects, (TABLE, *box_obstacles(packing.box)), CONFIG.pick_place
    )
    placement = next(p for p in packing.placements if p.name == "can_1")
    plan = planner.plan(placement, np.asarray(arm.q_home))
    world, grasp = planner.scene.world, plan.grasp
    near = world.path_contact(
        plan.approach.positions[::20], grasp.opening, AllowedContacts(frozenset({"can_1"}))
    )
    assert near is None
    world.carry("can_1", np.linalg.inv(grasp.T_stand_tcp))
    held = grasp.held_width
    floor = AllowedContacts(touch_carried=frozenset({"table", "box_floor"}), carried_margin=0.0)
    way = np.concatenate([plan.lift.positions, plan.carry.positions, plan.lowering.positions])[::20]
    assert world.path_contact(way, held, floor) is None


class FakeObserver:
    """Reports what ``presence`` lists, then objects in place; finds objects where ``poses`` says.

    ``closer`` lists what closer looks at stacks show, each by name; after them, nothing. Nothing hangs in the
    air but ``lifted``. ``unknown`` are the points that nothing known explains. What is in the hand is seen
    ``shifted`` in the world, or not at all.
    """

    lifted = ()
    unknown = np.zeros((0, 3))
    shifted = None

    def __init__(self, presence=(), **findings):
        self.presence, self.findings, self.searched = list(presence), findings, []
        self.closer, self.looked_at = [], []
        self.obstacles = []  # things of no class that each look at the table shows

    def glance(self, poses, names):
        if any(poses[name][2, 3] > IN_THE_AIR for name in names):
            return {name: "in_place" if name in self.lifted else "displaced" for name in names}
        return {name: self.presence.pop(0) if self.presence else "in_place" for name in names}

    def unexpected(self, poses, obstacles, region):
        return self.unknown[region(self.unknown)]

    def held(self, name, poses, T_world_tcp):
        return None if self.shifted is None else self.shifted @ poses[name]

    def find(self, name, poses):
        self.searched.append(name)
        answers = self.findings.get(name, [])
        return answers.pop(0) if answers else Finding("found", poses[name]) if name in poses else MISSING

    def find_obstacles(self, poses):
        return self.obstacles.pop(0) if self.obstacles else None

    def look_closer(self, names, poses):
        self.looked_at.append(tuple(names))
        return self.closer.pop(0) if self.closer else {}


MISSING = Finding("missing")
IN_THE_AIR = 0.05  # [m] of the base of an object


def test_a_failed_grasp_is_retried_with_another_grasp_after_a_search(packing, arm):
    robot, observer = FakeRobot(arm, closing=[0.0]), FakeObserver()
    watcher = Watcher(robot)
    outcomes = execute(packing, robot, observer, watcher, CONFIG)
    first = packing.placements[0].name
    outcome = next(o for o in outcomes if o.name == first)
    assert outcome.placed and outcome.attempts == 2
    assert observer.searched == [first]
    tried = [event.plan.grasp for event in watcher.events if event.name == first and event.plan]
    turn = np.angle(np.exp(1j * (tried[0].azimuth - tried[1].azimuth)))
    assert abs(turn) > np.deg2rad(15) or abs(tried[0].depth - tried[1].depth) > 0.002


def test_an_object_that_moved_is_grasped_where_it_is_without_a_failed_attempt(packing, arm):
    name = packing.placements[0].name
    T = packing.objects[name].T_world_stand.copy()
    T[0, 3] += 0.03
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    observer = FakeObserver(["displaced"], **{name: [Finding("found", T)]})
    outcomes = execute(packing, robot, observer, watcher, CONFIG)
    outcome = next(o for o in outcomes if o.name == name)
    assert outcome.placed and outcome.attempts == 1
    plan = watcher.plans[name]
    T_grasp = Kinematics(arm).forward(plan.approach.positions[-1])
    np.testing.assert_allclose(T_grasp, T @ plan.grasp.T_stand_tcp, atol=2e-3)


@pytest.mark.parametrize(("shift", "approaches"), [(0.002, 2), (0.03, 3)])
def test_an_object_that_is_found_where_one_image_missed_it_is_grasped_without_another_look(
    packing, arm, shift, approaches
):
    """The second of two images that miss it comes before the grasp only of an object that was moved."""
    single = replace(packing, placements=packing.placements[:1])
    name = single.placements[0].name
    T = packing.objects[name].T_world_stand.copy()
    T[0, 3] += shift
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    observer = FakeObserver(["displaced"] * 2, **{name: [Finding("found", T)]})
    (outcome,) = execute(single, robot, observer, watcher, CONFIG)
    assert outcome.placed and outcome.attempts == 1
    assert watcher.phases(name).count("approach") == approaches


def test_an_object_that_was_taken_away_is_searched_for_twice_and_reported(packing, arm):
    name = "can_1"
    robot = FakeRobot(arm)
    index = [p.name for p in packing.placements].index(name)
    presence = ["in_place"] * 2 * index + ["displaced"]
    observer = FakeObserver(presence, **{name: [MISSING, MISSING]})
    outcomes = {o.name: o for o in execute(packing, robot, observer, Watcher(robot), CONFIG)}
    assert [o.placed for o in outcomes.values()].count(False) == 1 and not outcomes[name].placed
    assert "can_1 is nowhere on the table within view" in outcomes[name].reason
    assert observer.searched == [name, name] and list(outcomes)[-1] == name


@pytest.mark.slow
def test_an_object_that_was_not_placed_gets_another_chance_after_the_others(packing, arm):
    robot = FakeRobot(arm, closing=[0.0, 0.0, 0.0])
    outcomes = execute(packing, robot, FakeObserver(), Watcher(robot), CONFIG)
    assert all(outcome.placed for outcome in outcomes)
    assert next(o for o in outcomes if o.name == packing.placements[0].name).attempts == 4


def test_an_object_seen_beside_its_goal_is_grasped_again(packing, arm):
    single = replace(packing, placements=packing.placements[:1])
    name = single.placements[0].name
    T = packing.objects[name].T_world_stand
    robot = FakeRobot(arm)
    observer = FakeObserver(["in_place", "displaced"], **{name: [Finding("found", T)] * 2})
    (outcome,) = execute(single, robot, observer, Watcher(robot), CONFIG)
    assert outcome.placed and outcome.attempts == 2


class Knocked(FakeObserver):
    """Sees once that one object beside another has gone to a pose."""

    def __init__(self, name, T_world_stand):
        super().__init__()
        self.name, self.T_world_stand = name, T_world_stand

    def glance(self, poses, names):
        gone = self.T_world_stand is not None and self.name in names and len(poses) > len(names) > 0
        is_beside = gone and names != (self.name,)
        return {n: "displaced" if is_beside and n == self.name else "in_place" for n in names}

    def find(self, name, poses):
        self.searched.append(name)
        T, self.T_world_stand = self.T_world_stand, None
        return Finding("found", T)


@pytest.mark.parametrize(
    ("to", "again"), [((0.45, -0.45, 0.0), True), ((0.43, 0.24, 0.0), False)], ids=["table", "box"]
)
def test_what_another_object_knocks_away_is_placed_again_unless_it_stands_in_the_box(
    packing, arm, monkeypatch, to, again
):
    monkeypatch.setattr("manipulation.scene_following.BESIDE", 1.0)
    packing = replace(packing, placements=(packing.placements[0], packing.placements[2]))
    robot, name = FakeRobot(arm), packing.placements[0].name
    observer, watcher = Knocked(name, pose_from_yaw(0.0, np.array(to))), Watcher(robot)
    outcomes = {outcome.name: outcome for outcome in execute(packing, robot, observer, watcher, CONFIG)}
    assert observer.searched == [name] and all(outcome.placed for outcome in outcomes.values())
    assert watcher.phases(name).count("placed") == (2 if again else 1)
    assert outcomes[name].attempts == (2 if again else 1)
    assert ("deferred" in watcher.phases(name)) == again


def test_what_is_knocked_away_without_another_chance_is_reported(packing, arm, monkeypatch):
    monkeypatch.setattr("manipulation.scene_following.BESIDE", 1.0)
    monkeypatch.setattr(TaskProgress, "gets_another_chance", lambda *_: False)
    packing = replace(packing, placements=(packing.placements[0], packing.placements[2]))
    robot, (first, second) = FakeRobot(arm), (p.name for p in packing.placements)
    observer = Knocked(first, pose_from_yaw(0.0, np.array([0.45, -0.45, 0.0])))
    outcomes = {o.name: o for o in execute(packing, robot, observer, Watcher(robot), CONFIG)}
    assert outcomes[second].placed and not outcomes[first].placed
    assert outcomes[first].reason == f"{first} was moved by {second}"
    assert outcomes[first].T_world_stand is None


def test_a_bowl_that_leans_in_another_is_grasped_as_it_was_seen(scene, packing, arm):
    two = replace(packing, placements=packing.placements[:2])
    lower, upper = two.placements
    assert upper.stack == (lower.name,)
    T = pose_from_yaw(0.0, np.array([*lower.position[:2], 0.05]))
    T[:3, :3] = so3_exp(np.array([np.deg2rad(28), 0.0, 0.0])) @ T[:3, :3]
    robot, observer = FakeRobot(arm), FakeObserver()
    observer.closer = [{upper.name: T}] * (1 + MAX_PRESSES)  # presses do not help
    watcher = Watcher(robot)
    outcomes = {o.name: o for o in execute(two, robot, observer, watcher, CONFIG)}
    assert outcomes[upper.name].placed and outcomes[upper.name].attempts == 2 and not observer.searched
    plan = watcher.plans[upper.name]
    T_grasp = Kinematics(arm).forward(plan.approach.positions[-1])
    np.testing.assert_allclose(T_grasp, T @ plan.grasp.T_stand_open, atol=2e-3)


def test_object_that_cannot_be_held_fails_after_two_retries(packing, arm):
    robot = FakeRobot(arm, closing=[0.0, 0.0, 0.0])
    outcomes = execute(packing, robot, None, Watcher(robot), CONFIG)
    failed = [outcome for outcome in outcomes if not outcome.placed]
    assert len(failed) == 1 and failed[0].attempts == 3 and failed[0].T_world_stand is None
    assert "no object between the fingers after closing on bowl_2 (width 0.0 mm, expected" in failed[0].reason
    # The bowl that was to stand in it now stands on the floor of the box.
    nested = next(outcome for outcome in outcomes if outcome.name == "bowl_3")
    assert nested.placed and nested.T_world_stand[2, 3] == pytest.approx(Box().floor)


def test_a_lying_can_is_set_upright_before_it_is_placed(scene, arm):
    task = plan_sort(scene[:1], Line(), arm, CONFIG)
    lying = task.objects["can_1"].T_world_stand.copy()
    lying[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    lying[2, 3] = 0.033
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    observer = FakeObserver(["displaced"], can_1=[Finding("found", lying)])
    (outcome,) = execute(task, robot, observer, watcher, CONFIG)
    assert outcome.placed and outcome.attempts == 1
    kinds = [event.plan.grasp.kind for event in watcher.events if event.plan]
    assert kinds[:2] == ["top", "waist"], "its goal may be free for the horizontal hand"


@pytest.mark.slow
def test_an_object_upside_down_is_reported(packing, arm):
    T = packing.objects["bowl_2"].T_world_stand @ np.diag([1.0, -1, -1, 1])
    robot = FakeRobot(arm)
    observer = FakeObserver(["displaced"], bowl_2=[Finding("found", T)] * 2)
    outcomes = execute(packing, robot, observer, Watcher(robot), CONFIG)
    failed = next(outcome for outcome in outcomes if outcome.name == "bowl_2")
    assert not failed.placed and failed.attempts == 0 and "bowl_2 stands upside down at" in failed.reason
    assert "turn it over by hand" in failed.reason and "gripper" not in failed.reason


@pytest.mark.slow
def test_a_search_updates_the_obstacles(packing, arm):
    """A thing that came to stand over the bowl blocks it; once it is gone, the second chance succeeds."""
    T = packing.objects["bowl_2"].T_world_stand
    corners = np.array(list(itertools.product((-0.06, 0.06), (-0.06, 0.06), (0.06, 0.1))))
    thing = PerceivedObstacle(7, (T[:3, 3] + corners,), 500)
    robot = FakeRobot(arm)
    found = [Finding("found", T, obstacles=(thing,)), Finding("found", T, obstacles=())]
    watcher, observer = Watcher(robot), FakeObserver(["displaced"], bowl_2=found)
    outcomes = execute(packing, robot, observer, watcher, CONFIG)
    assert all(outcome.placed for outcome in outcomes)
    deferred = next(event for event in watcher.events if event.phase == "deferred")
    assert deferred.name == "bowl_2" and "thing_7" in deferred.message


def thing_over(T_world_stand):
    corners = np.array(list(itertools.product((-0.06, 0.06), (-0.06, 0.06), (0.1, 0.14))))
    return PerceivedObstacle(7, (T_world_stand[:3, 3] + corners,), 500)


@pytest.mark.parametrize("is_seen", [True, False], ids=["seen", "felt"])
def test_what_is_met_on_the_way_to_an_object_is_an_obstacle_from_then_on(packing, arm, is_seen):
    """The thing is not in the object map, and covers the can that the hand goes for."""
    single = replace(packing, placements=tuple(p for p in packing.placements if p.name == "can_1"))
    T = packing.objects["can_1"].T_world_stand
    robot, observer = FakeRobot(arm), FakeObserver()
    if is_seen:
        observer.unknown = T[:3, 3] + np.random.default_rng(0).uniform(-0.03, 0.03, (2000, 3)) + (0, 0, 0.12)
    else:
        robot.blocked_motions = {2}  # the approach
    observer.obstacles = [(thing_over(T),)]
    (outcome,) = execute(single, robot, observer, Watcher(robot), CONFIG)
    assert not outcome.placed and outcome.attempts == 1 and "thing_7" in outcome.reason


def test_an_object_to_which_something_unknown_bars_the_way_is_left_soon(packing, arm):
    """Each touch may move what is unknown: two attempts, and one more once the others are placed."""
    name = packing.placements[0].name
    T = packing.objects[name].T_world_stand
    robot, observer = FakeRobot(arm), FakeObserver()
    observer.unknown = T[:3, 3] + np.random.default_rng(0).uniform(-0.05, 0.05, (9000, 3)) + (0, 0, 0.12)
    watcher = Watcher(robot)
    outcomes = {o.name: o for o in execute(packing, robot, observer, watcher, CONFIG)}
    assert not outcomes[name].placed and outcomes[name].attempts == 3
    assert "something unknown" in outcomes[name].reason and "grasp" not in watcher.phases(name)


def test_blocked_arm_counts_as_a_failed_attempt(packing, arm):
    robot = FakeRobot(arm)
    robot.blocked_motions = {1}
    outcomes = execute(packing, robot, None, Watcher(robot), CONFIG)
    assert outcomes[0].placed and outcomes[0].attempts == 2


def test_what_met_something_on_its_way_is_placed_elsewhere(packing, arm):
    class Meeting(FakeRobot):
        met = False

        def follow(self, trajectory):
            if watcher.events[-1].phase == "transfer" and not self.met:
                self.met = True
                raise RobotError("the arm is blocked")
            super().follow(trajectory)

    robot = Meeting(arm)
    watcher = Watcher(robot)
    outcomes = execute(packing, robot, None, watcher, CONFIG)
    name = packing.placements[0].name
    plans = [event.plan for event in watcher.events if event.phase == "approach" and event.name == name]
    first, second = (np.array(plan.placement.position) for plan in plans)
    assert np.linalg.norm(second - first) > 0.02
    assert outcomes[0].placed and outcomes[0].attempts == 2


def test_a_stopped_robot_ends_the_task_and_keeps_what_was_placed(packing, arm):
    class Stopping(FakeRobot):
        def follow(self, trajectory):
            if len(self.motions) == 8:  # in the second object
                raise RobotStoppedError("a person is near")
            super().follow(trajectory)

    robot = Stopping(arm)
    outcomes = execute(packing, robot, None, Watcher(robot), CONFIG)
    assert len(outcomes) == len(packing.placements) and outcomes[0].placed
    assert {outcome.reason for outcome in outcomes[1:]} == {"a person is near"}
    assert [outcome.attempts for outcome in outcomes[1:]] == [1, *[0] * (len(outcomes) - 2)]
    assert len(robot.motions) == 8


def test_object_lost_during_the_transfer_is_detected(packing, arm):
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    lost = []

    def drop_once(event):
        watcher(event)
        if event.phase == "place" and not lost:
            lost.append(event.name)
            robot.width = 0.0

    outcomes = execute(packing, robot, None, drop_once, CONFIG)
    assert all(outcome.placed for outcome in outcomes)
    assert next(event.message for event in watcher.events if event.phase == "retry").startswith(
        f"{lost[0]} was lost during the transfer"
    )


def test_blocked_object_is_deferred_until_the_others_are_moved(packing, arm, monkeypatch):
    planned = []
    plan = PickPlacePlanner.plan

    def blocked_at_first(self, placement, q_start, tried=(), grasps=None, contents=()):
        planned.append(placement[0].name)
        if placement[0].name == "bowl_2" and planned.count("bowl_2") == 1:
            raise PlanningError("No plan for bowl_2: of 9 candidates, 9 collide with can_1; clear it")
        return plan(self, placement, q_start, tried)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked_at_first)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(packing, robot, None, watcher, CONFIG)
    assert all(outcome.placed for outcome in outcomes)
    # The bowl that nests in it waits for it.
    assert [o.name for o in outcomes] == ["can_1", "bowl_2", "bowl_3"]
    deferred = [event for event in watcher.events if event.phase == "deferred"]
    assert [event.name for event in deferred] == ["bowl_2"] and "9 collide with can_1" in deferred[0].message


def test_a_hand_that_no_path_leads_away_from_is_moved_above_the_objects(packing, arm, monkeypatch):
    """After the first object the hand is low; the plan for the next one begins above via height."""
    plan, starts, kinematics = PickPlacePlanner.plan, [], Kinematics(arm)

    def enclosed_when_low(self, placement, q, *args, **options):
        starts.append(kinematics.forward(q)[2, 3])
        if starts[-1] < CONFIG.pick_place.via_heights[0] - 2e-3:
            raise NoPlanError("no way", (), is_enclosed=True)
        return plan(self, placement, q, *args, **options)

    monkeypatch.setattr(PickPlacePlanner, "plan", enclosed_when_low)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(packing, robot, on_event=watcher, config=CONFIG)
    assert all(outcome.placed for outcome in outcomes) and min(starts) < 0.3
    assert not any(event.phase == "deferred" for event in watcher.events)


def test_what_an_object_blocked_comes_next_once_that_is_moved(scene, shapes, arm, monkeypatch):
    """Not after all others, whose places may block its goal."""
    cans = [shapes.estimate(i, "can", shapes.can(), x=0.1 * i, y=-0.4) for i in (4, 5)]
    task = plan_sort([*scene[:1], *cans], Line(), arm, CONFIG)
    first, second, third = (placement.name for placement in task.placements)
    plan, failed = PickPlacePlanner.plan, []

    def blocked_at_first(self, placement, q_start, tried=(), grasps=None, contents=()):
        if placement[0].name == first and not failed:
            failed.append(first)
            raise NoPlanError("blocked", (second,))
        return plan(self, placement, q_start, tried)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked_at_first)
    robot = FakeRobot(arm)
    outcomes = execute(task, robot, None, Watcher(robot), CONFIG)
    assert [outcome.name for outcome in outcomes] == [second, first, third]


@pytest.mark.parametrize(
    ("enclosing", "order"),
    [
        ((), [1, 2, 0]),  # nothing encloses a place: the first object waits for its turn
        ((1,), [2, 0, 1]),  # the second would enclose the first: the third, which is in its way, comes first
    ],
)
def test_the_order_in_which_what_is_in_the_way_is_placed(shapes, arm, monkeypatch, enclosing, order):
    cans = [shapes.estimate(i, "can", shapes.can(), x=0.3 + 0.1 * i, y=-0.3) for i in range(3)]
    task = plan_sort(cans, Line(), arm, CONFIG)
    names = [placement.name for placement in task.placements]
    plan, failed = PickPlacePlanner.plan, []

    def blocked_at_first(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        if placements[0].name == names[0] and not failed:
            failed.append(names[0])
            raise NoPlanError("blocked", (names[2],))
        return plan(self, placements, q_start, tried, grasps)

    def can_place_after(self, placement, before):
        return not {names[i] for i in enclosing} & {goal.name for goal in before}

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked_at_first)
    monkeypatch.setattr(PickPlacePlanner, "can_place_after", can_place_after)
    robot = FakeRobot(arm)
    outcomes = execute(task, robot, None, Watcher(robot), CONFIG)
    assert [outcome.name for outcome in outcomes] == [names[i] for i in order]


def test_what_would_enclose_the_goal_of_what_it_blocks_is_set_aside_first(scene, shapes, arm, monkeypatch):
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    first, second = (placement.name for placement in task.placements)
    plan, failed = PickPlacePlanner.plan, []

    def blocked_at_first(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        if placements[0].name == first and not failed:
            failed.append(first)
            raise NoPlanError("blocked", (second,))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked_at_first)
    monkeypatch.setattr(PickPlacePlanner, "can_place_after", lambda *_: False)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(task, robot, None, watcher, CONFIG)
    assert [outcome.name for outcome in outcomes] == [first, second]
    assert all(outcome.placed for outcome in outcomes)
    assert [event.name for event in watcher.events if event.phase == "aside"] == [second]


def test_a_placed_object_that_blocks_another_is_set_aside_and_placed_again(scene, arm, monkeypatch):
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    first, second = (placement.name for placement in task.placements)
    plan, goal = PickPlacePlanner.plan, np.array(task.placements[0].position[:2])

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        is_blocked = np.linalg.norm(self.scene.pose(first)[:2, 3] - goal) < 0.01
        if placements[0].name == second and is_blocked and first not in self.scene.forgotten:
            raise NoPlanError("blocked", (first,))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(task, robot, None, watcher, CONFIG)
    assert [(outcome.name, outcome.placed) for outcome in outcomes] == [(second, True), (first, True)]
    assert [event.name for event in watcher.events if event.phase == "aside"] == [first]
    assert outcomes[1].T_world_stand[:2, 3] == pytest.approx(goal)


def test_a_placed_object_is_not_moved_for_one_that_has_no_plan_without_it_either(scene, arm, monkeypatch):
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    first, second = (placement.name for placement in task.placements)
    plan = PickPlacePlanner.plan

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        if placements[0].name == second:
            raise NoPlanError("blocked", ("table",) if first in self.scene.forgotten else (first, "table"))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = {o.name: o.placed for o in execute(task, robot, None, watcher, CONFIG)}
    assert outcomes == {first: True, second: False}
    assert not [event for event in watcher.events if event.phase == "aside"]


def test_an_object_whose_neighbours_block_its_way_is_itself_set_aside(scene, arm, monkeypatch):
    """Where no neighbour can be moved; from free table it is then placed at its goal."""
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    name = task.placements[0].name
    start = task.objects[name].T_world_stand[:2, 3]
    plan, goal = PickPlacePlanner.plan, np.array(task.placements[0].position[:2])

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        is_at_start = np.linalg.norm(self.scene.pose(name)[:2, 3] - start) < 0.01
        is_goal = np.linalg.norm(np.subtract(placements[0].position[:2], goal)) < 0.01
        if placements[0].name == name and is_at_start and is_goal:
            raise NoPlanError("blocked", ("obstacle_1",))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = {o.name: o for o in execute(task, robot, None, watcher, CONFIG)}
    assert [(e.name, e.message) for e in watcher.events if e.phase == "aside"] == [
        (name, "its neighbours block its way")
    ]
    assert outcomes[name].placed
    assert outcomes[name].T_world_stand[:2, 3] == pytest.approx(goal)


def grasps_nothing_aside(robot, watcher):
    """A watcher in whose sight what is set aside is not held."""

    def watch(event):
        watcher(event)
        if event.phase == "aside":
            robot.closing = [0.0]

    return watch


def test_an_object_lost_while_it_is_itself_set_aside_is_not_planned(scene, arm, monkeypatch):
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    name, goal = task.placements[0].name, task.placements[0].position[:2]
    plan = PickPlacePlanner.plan

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        assert placements[0].name not in self.scene.forgotten
        if placements[0].name == name and np.allclose(placements[0].position[:2], goal):
            raise NoPlanError("blocked", ("obstacle_1",))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)

    observer = FakeObserver(**{name: [MISSING] * 9})
    outcomes = {
        o.name: o for o in execute(task, robot, observer, grasps_nothing_aside(robot, watcher), CONFIG)
    }
    assert any(event.phase == "aside" and event.name == name for event in watcher.events)
    assert not outcomes[name].placed and outcomes[task.placements[1].name].placed
    assert outcomes[name].T_world_left is None, "it is nowhere"


def test_a_blocker_lost_while_it_is_set_aside_is_searched_for_before_it_is_planned(scene, arm, monkeypatch):
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    first, second = (placement.name for placement in task.placements)
    plan = PickPlacePlanner.plan

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        if placements[0].name == second and first not in self.scene.forgotten:
            raise NoPlanError("blocked", (first,))
        assert placements[0].name not in self.scene.forgotten
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)

    observer = FakeObserver(**{first: [MISSING] * 9})
    outcomes = {
        o.name: o for o in execute(task, robot, observer, grasps_nothing_aside(robot, watcher), CONFIG)
    }
    assert outcomes[second].placed and not outcomes[first].placed
    assert "nowhere" in outcomes[first].reason


def test_a_nested_bowl_is_placed_where_the_one_below_is(packing, arm):
    """The lower bowl is found 8 mm from its goal after its release."""
    goal = next(p for p in packing.placements if p.name == "bowl_2").position
    T = pose_from_yaw(0.0, np.add(goal, (0.008, -0.004, 0.0)))
    observer = FakeObserver(["in_place", "displaced"], bowl_2=[Finding("found", T)])
    assert packing.placements[0].name == "bowl_2"
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = {o.name: o for o in execute(packing, robot, observer, watcher, CONFIG)}
    assert observer.looked_at == [("bowl_3", "bowl_2")]
    nested = watcher.plans["bowl_3"].T_world_stand_rest
    assert outcomes["bowl_3"].placed and nested[:2, 3] == pytest.approx(T[:2, 3])


def test_bowls_that_no_finger_fits_between_are_carried_as_one(shapes, arm):
    """The upper rim is 5 mm below the lower one and 22 mm inside it."""
    nested = [
        shapes.estimate(1, "bowl", shapes.bowl(0.08, 0.07), x=0.5, y=-0.25),
        shapes.estimate(2, "bowl", shapes.bowl(0.053, 0.033), x=0.5, y=-0.25, lift=0.032),
    ]
    task = plan_pack(nested, Box(), arm, CONFIG)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(task, robot, on_event=watcher, config=CONFIG)
    assert sorted((o.name, o.placed) for o in outcomes) == [("bowl_1", True), ("bowl_2", True)]
    assert list(watcher.plans) == ["bowl_1"] and watcher.plans["bowl_1"].contents == ("bowl_2",)
    lower, upper = (
        next(o for o in outcomes if o.name == name).T_world_stand for name in ("bowl_1", "bowl_2")
    )
    assert upper[:3, 3] - lower[:3, 3] == pytest.approx((0, 0, 0.032), abs=1e-6)
    assert Box().contains(upper)


def test_object_that_stays_blocked_fails_and_releases_its_stack(packing, arm, monkeypatch):
    plan = PickPlacePlanner.plan

    def never(self, placement, q_start, tried=(), grasps=None, contents=()):
        if len(placement) > 1 or placement[0].name == "bowl_2":
            raise PlanningError("No plan for bowl_2")
        return plan(self, placement, q_start, tried)

    monkeypatch.setattr(PickPlacePlanner, "plan", never)
    robot = FakeRobot(arm)
    outcomes = {o.name: o for o in execute(packing, robot, None, Watcher(robot), CONFIG)}
    assert not outcomes["bowl_2"].placed and outcomes["bowl_2"].attempts == 0
    assert outcomes["bowl_2"].reason == "No plan for bowl_2"
    assert outcomes["can_1"].placed and outcomes["bowl_3"].placed
    assert outcomes["bowl_3"].T_world_stand[2, 3] == pytest.approx(Box().floor)


def test_object_whose_goal_stays_blocked_is_placed_elsewhere_in_the_box(packing, arm, monkeypatch):
    plan = PickPlacePlanner.plan
    (goal,) = (placement for placement in packing.placements if placement.name == "can_1")

    def blocked(self, placement, q_start, tried=(), grasps=None, contents=()):
        if placement == [goal]:
            raise PlanningError("No plan for can_1")
        return plan(self, placement, q_start, tried)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    outcomes = {o.name: o for o in execute(packing, robot, None, Watcher(robot), CONFIG)}
    assert all(outcome.placed for outcome in outcomes.values())
    place, box = outcomes["can_1"].T_world_stand[:2, 3], packing.box
    assert np.linalg.norm(place - goal.position[:2]) > 0.01
    assert (np.abs(place - box.center) < np.array(box.size[:2]) / 2).all()


def test_unreachable_goal_is_reported_with_counts(scene, arm):
    items = {item.name: item for item in map(to_standing, scene)}
    config = PickPlaceConfig(grasp=GraspConfig(n_azimuths=4, top_depths=(0.02,)))
    planner = PickPlacePlanner(Kinematics(arm), items, config=config)
    with pytest.raises(PlanningError, match=r"No plan for can_1: of \d+ candidates, .*goal out of reach"):
        planner.plan(Placement("can_1", (1.3, 0.2, 0.0), (0.0,)), np.asarray(arm.q_home))


def test_sorting_of_mugs(scene, shapes, arm):
    mug = shapes.estimate(0, "mug", shapes.mug(), x=0.38, y=-0.38, yaw=2.0)
    task = plan_sort([mug, *scene[:2]], Line(), arm, CONFIG)
    robot = FakeRobot(arm)
    outcomes = execute(task, robot, None, Watcher(robot), CONFIG)
    assert len(outcomes) == 3 and all(outcome.placed for outcome in outcomes)
    assert all(outcome.T_world_stand[2, 3] == 0 for outcome in outcomes)


def test_gripper_commands_of_one_object(packing, arm):
    """Open, close, for a bowl loosen by the release gap before it settles, then open to the release width."""
    single = replace(packing, placements=packing.placements[:1])
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    (outcome,) = execute(single, robot, on_event=watcher, config=CONFIG)
    assert outcome.placed and outcome.name == "bowl_2"
    grasp, gap = watcher.plans["bowl_2"].grasp, CONFIG.pick_place.grasp.release_gap
    release = max(grasp.held_width + 2 * gap, watcher.plans["bowl_2"].release_opening)
    assert robot.widths == pytest.approx([grasp.opening, 0.0, grasp.held_width + gap, release])
    # approach, lift, transfer, settle, retreat, and at least one motion home
    assert len(robot.motions) >= 6 and robot.q == pytest.approx(arm.q_home)


@pytest.mark.parametrize("excess, held", [(-0.0005, True), (0.0005, False)])
def test_widths_outside_the_closed_range_count_as_a_failed_grasp(packing, arm, excess, held):
    single = replace(packing, placements=packing.placements[:1])
    robot = FakeRobot(arm)
    watcher = Watcher(robot)

    def wide(event):
        watcher(event)
        if event.plan is not None:
            robot.expected = event.plan.grasp.closed_width[1] + excess

    (outcome,) = execute(single, robot, on_event=wide, config=replace(CONFIG, max_retries=0))
    assert outcome.placed == held and outcome.attempts == 1
    if not held:
        # After a failed grasp the gripper opens as far as before, which a small bowl has room for, and rises.
        assert robot.widths[-1] == watcher.plans[outcome.name].grasp.opening < arm.max_width
        kinematics = Kinematics(arm)
        rise = [kinematics.forward(robot.motions[2].positions[i])[2, 3] for i in (0, -1)]
        assert rise[1] - rise[0] == pytest.approx(0.15, abs=1e-3)
        assert "no object between the fingers after closing on bowl_2" in outcome.reason


def test_object_lost_during_the_lift_is_detected(packing, arm):
    single = replace(packing, placements=packing.placements[:1])
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    follow = robot.follow

    def lose(trajectory):
        follow(trajectory)
        if len(robot.motions) == 3:
            robot.width = 0.0

    robot.follow = lose
    (outcome,) = execute(single, robot, on_event=watcher, config=replace(CONFIG, max_retries=0))
    assert not outcome.placed and outcome.reason.startswith("bowl_2 was lost during the lift")


def test_an_object_that_no_hand_fits_beside_is_pushed_and_grasped_where_it_is_found(scene, arm, monkeypatch):
    """At most MAX_PUSHES times; here the first push does not move it."""
    task = plan_sort(scene[:2], Line(), arm, CONFIG)
    name = task.placements[0].name
    start = task.objects[name].T_world_stand
    pushed = pose_from_yaw(0.0, start[:3, 3] + np.array([0.05, 0.0, 0.0]))
    plan = PickPlacePlanner.plan

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        if placements[0].name == name and np.allclose(self.scene.pose(name), start):
            raise NoPlanError("blocked", ("thing_1",))
        return plan(self, placements, q_start, tried, grasps)

    def plan_stub(motions, item, q_start, helps):
        still = joint_move(q_start, q_start, motions.limits)
        return Push(item.name, still, still, still, still, pushed)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    monkeypatch.setattr(object_planning, "plan_push", plan_stub)
    for found, n_pushes in (([start, pushed], 2), ([start] * 9, MAX_PUSHES)):
        robot = FakeRobot(arm)
        watcher = Watcher(robot)
        observer = FakeObserver(**{name: [Finding("found", T) for T in found]})
        outcomes = {o.name: o for o in execute(task, robot, observer, watcher, CONFIG)}
        assert watcher.phases(name).count("push") == n_pushes
        assert outcomes[name].placed == (len(found) == 2)
    watcher = Watcher(FakeRobot(arm))
    execute(task, watcher.robot, None, watcher, CONFIG)
    assert "push" not in watcher.phases(name), "without an observer its pose afterwards is unknown"


def test_what_stood_in_the_box_before_is_set_aside_for_another_object_and_put_back(scene, arm, monkeypatch):
    """It has no goal of its own in this round."""
    task = plan_pack(scene[:2], Box(), arm, CONFIG)
    old, new = "can_1", "bowl_2"
    goals = {placement.name: placement for placement in task.placements}
    there = pose_from_yaw(0.0, np.array([*goals[old].position[:2], Box().floor]))
    task = replace(
        task,
        placements=(goals[new],),
        objects=dict(task.objects) | {old: replace(task.objects[old], T_world_stand=there)},
    )
    plan = PickPlacePlanner.plan

    def blocked(self, placements, q_start, tried=(), grasps=None, contents=()):
        placements = [placements] if isinstance(placements, Placement) else placements
        is_there = np.linalg.norm((self.scene.pose(old) - there)[:2, 3]) < 0.01
        if placements[0].name == new and is_there and old not in self.scene.forgotten:
            raise NoPlanError("blocked", (old,))
        return plan(self, placements, q_start, tried, grasps)

    monkeypatch.setattr(PickPlacePlanner, "plan", blocked)
    robot = FakeRobot(arm)
    watcher = Watcher(robot)
    outcomes = execute(task, robot, FakeObserver(), watcher, CONFIG)
    assert [(outcome.name, outcome.placed) for outcome in outcomes] == [(new, True), (old, True)]
    assert [event.name for event in watcher.events if event.phase == "aside"] == [old]
    assert outcomes[1].T_world_stand[:2, 3] == pytest.approx(there[:2, 3], abs=0.05)
    assert max(event.done for event in watcher.events) <= max(event.total for event in watcher.events)


def test_in_a_row_less_is_misplaced_than_in_a_box(packing, arm, monkeypatch):
    limits = []

    class Recorded(PlanExecution):
        def __init__(self, *args):
            super().__init__(*args)
            limits.append(self.misplaced)

    monkeypatch.setattr(execution, "PlanExecution", Recorded)
    for task in (packing, replace(packing, task="sort", box=None)):
        robot = FakeRobot(arm)
        execute(task, robot, on_event=Watcher(robot), config=CONFIG)
    assert limits == [MISPLACED, OFF_ROW]
