import contextlib
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from manipulation import object_planning, open_places
from manipulation.errors import NoPlanError, PlanningError
from manipulation.object_planning import DOUBTFUL, DROP, LOW, Effort, ObjectPlanning
from manipulation.pick_place import PickPlacePlanner
from manipulation.planner import ManipulationConfig
from manipulation.planning_scene import PlanningScene, SceneState
from manipulation.pushing import Push
from manipulation.standing import to_standing
from manipulation.types import Box, Grasp, GraspSet, PickPlacePlan, Placement, TaskPlan
from perception.geometry import pose_from_yaw

Q = np.zeros(7)
GOAL = Placement("can_1", (0.5, 0.25, 0.004), (0.0,))
CONFIG = ManipulationConfig()


def grasp(score=0.5):
    """A grasp of which nothing but the score is known."""
    made = object.__new__(Grasp)
    object.__setattr__(made, "score", score)
    return made


@pytest.fixture(autouse=True)
def room_for_the_hand_everywhere(monkeypatch):
    monkeypatch.setattr("manipulation.free_places.count_free_releases", lambda *_: 1)


GRASPS, TILTED, KEEPING = (GraspSet((grasp(),), Counter()) for _ in range(3))
FOUND = grasp()  # that of a plan


class FakeScene(PlanningScene):
    """Objects at ``Ts``, on which no collision is ever checked."""

    def __init__(self, items):
        self.items, self.found, self.state = items, GRASPS, SceneState()
        self._obstacles = ()
        self.absent: frozenset[str] = frozenset()
        self.Ts = {name: item.T_world_stand for name, item in items.items()}

    def pose(self, name):
        return self.Ts[name]

    def poses(self):
        return dict(self.Ts)

    @contextlib.contextmanager
    def without(self, names):
        before, self.absent, state = self.absent, frozenset(names), self.state
        self.state = SceneState()
        yield
        self.absent, self.state = before, state

    @contextlib.contextmanager
    def supposing(self, name, T_world_stand):
        T_now, self.Ts[name] = self.Ts[name], T_world_stand
        yield
        self.Ts[name] = T_now

    def grasps(self, name):
        return self.found

    def tilted_grasps(self, name):
        return TILTED

    def keeping_grasps(self, name):
        return KEEPING


class FakePlanner(PickPlacePlanner):
    """Records what it is asked to plan; ``feasible`` decides by goals and grasps."""

    def __init__(self, items, feasible=lambda goals, grasps: False):
        self.scene = FakeScene(items)
        self.feasible, self.requests, self.contents = feasible, [], []
        self.pickable, self.examined = (lambda T: True), []
        self.within_reach = lambda position: True

    @property
    def motions(self):
        return None

    def can_pick(self, name, T_world_stand, grasps=None):
        self.examined.append((T_world_stand, grasps))
        return self.pickable(T_world_stand)

    def reaches(self, placement):
        return self.within_reach(placement.position)

    def plan(self, goals, q, tried=(), grasps=None, contents=()):
        goals = [goals] if isinstance(goals, Placement) else list(goals)
        self.requests.append((goals, grasps))
        self.contents.append(contents)
        if not self.feasible(goals, grasps):
            raise NoPlanError("No plan", ("bowl_2",))
        plan = object.__new__(PickPlacePlan)
        plan.__dict__.update(name=goals[0].name)
        return plan


@pytest.fixture(scope="module")
def items(shapes):
    found = [
        shapes.estimate(1, "can", shapes.can(), x=0.55, y=-0.2),
        shapes.estimate(2, "bowl", shapes.bowl(), x=0.4, y=-0.15),
    ]
    return {estimate.name: to_standing(estimate) for estimate in found}


def planning(items, planner):
    return ObjectPlanning(TaskPlan("pack", items, (GOAL,), box=Box()), planner, CONFIG)


def test_the_plain_effort_is_the_goal_with_the_grasps_of_the_shape(items):
    planner = FakePlanner(items)
    with pytest.raises(NoPlanError) as error:
        planning(items, planner).next_plan(GOAL, Q)
    assert error.value.blockers == ("bowl_2",)
    assert planner.requests == [([GOAL], None)]


def test_what_failed_is_not_tried_again_until_the_scene_changes(items):
    planner = FakePlanner(items)
    planned = planning(items, planner)
    states = SceneState(), SceneState()
    for state, n_requests in ((0, 1), (0, 1), (1, 2)):
        planner.scene.state = states[state]
        with pytest.raises(NoPlanError):
            planned.next_plan(GOAL, Q)
        assert len(planner.requests) == n_requests


def test_a_place_that_was_narrowed_is_shifted_and_the_planned_one_comes_second(items):
    planner = FakePlanner(items, lambda goals, grasps: True)
    beside = pose_from_yaw(0.0, np.array(GOAL.position))
    beside[0, 3] -= 0.09  # the bowl is within 2 mm of where the can is to stand
    planner.scene.Ts["bowl_2"] = beside
    planning(items, planner).next_plan(GOAL, Q)
    ((shifted, planned), grasps) = planner.requests[0]
    assert planned == GOAL and grasps is None and shifted.name == GOAL.name
    assert shifted.position[0] > GOAL.position[0]


def test_what_waits_is_no_obstacle_but_its_goal_is(items):
    planner = FakePlanner(items, lambda goals, grasps: True)
    beside = pose_from_yaw(0.0, np.array(GOAL.position))
    beside[0, 3] -= 0.09
    planner.scene.Ts["bowl_2"] = beside
    later = Placement("can_3", (GOAL.position[0] + 0.07, *GOAL.position[1:]), (0.0,))
    objects = items | {"can_3": replace(items["can_1"], id=3, name="can_3")}
    planner.scene.Ts["can_3"] = items["can_1"].T_world_stand
    task = TaskPlan("pack", objects, (GOAL, later), box=Box())
    ObjectPlanning(task, planner, CONFIG).next_plan(GOAL, Q)
    goals = planner.requests[0][0]
    assert all(np.linalg.norm(np.subtract(g.position, later.position)) > 0.066 for g in goals)


@pytest.mark.parametrize(
    ("stack", "blocked", "is_elsewhere"), [((), 1, True), (("bowl_2",), 1, False), (("bowl_2",), 2, True)]
)
def test_what_met_something_on_its_way_goes_elsewhere_first(items, stack, blocked, is_elsewhere):
    """The goal itself remains the last resort; what is to stand in a bowl gets a second chance there."""
    planner = FakePlanner(items, lambda goals, grasps: True)
    goal = replace(GOAL, stack=stack)
    planning(items, planner).next_plan(goal, Q, blocked=blocked)
    goals = planner.requests[0][0]
    assert goals[-1] == goal and (len(goals) > 1) is is_elsewhere
    assert all(other.position != goal.position for other in goals[:-1])


def test_of_other_places_those_with_room_for_the_hand_come_first(items, monkeypatch):
    def count(raster, grasps, pose, gripper):
        assert grasps is GRASPS.grasps
        return int(pose.position[1] < 0)

    monkeypatch.setattr("manipulation.free_places.count_free_releases", count)
    planner = FakePlanner(items, lambda goals, grasps: True)
    planning(items, planner).next_plan(GOAL, Q, blocked=1)
    *elsewhere, _ = planner.requests[0][0]
    has_room = [goal.position[1] < Box().center[1] for goal in elsewhere]
    assert has_room[0] and has_room == sorted(has_room, reverse=True)


def test_what_lies_and_met_something_is_turned_on_free_table_first(items):
    planner = FakePlanner(items, lambda goals, grasps: True)
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = 0.5, -0.2, 0.033
    planner.scene.Ts["can_1"] = T
    for blocked in (0, 1):
        planning(items, planner).next_plan(GOAL, Q, blocked=blocked)
    before, after = (goals for goals, _ in planner.requests)
    assert before[0] == GOAL and after == [*before[1:], GOAL] and len(after) > 1


def test_more_effort_is_other_places_and_then_any_angle(items):
    planner = FakePlanner(items, lambda goals, grasps: grasps is not None)
    planning(items, planner).next_plan(GOAL, Q, effort=Effort.FLEXIBLE)
    first, elsewhere, tilted = planner.requests
    assert first == ([GOAL], None) and tilted[1] is TILTED
    assert GOAL not in elsewhere[0] and elsewhere[1] is None and tilted[0] == [GOAL, *elsewhere[0]]
    box = Box()
    for goal in elsewhere[0]:
        assert (np.abs(np.subtract(goal.position[:2], box.center)) < np.array(box.size[:2]) / 2).all()


@pytest.mark.parametrize(("height", "is_dropped"), [(LOW - 0.01, True), (LOW + 0.01, False)])
def test_a_low_object_is_dropped_where_it_cannot_be_put_down(shapes, height, is_dropped):
    item = to_standing(shapes.estimate(1, "can", shapes.can(height=height), x=0.55, y=-0.2))
    planner = FakePlanner({"can_1": item}, lambda goals, grasps: goals[0].release_height > 0.01)
    planned = planning({"can_1": item}, planner)
    with pytest.raises(NoPlanError):
        planned.next_plan(GOAL, Q)
    if not is_dropped:
        with pytest.raises(NoPlanError):
            planned.next_plan(GOAL, Q, effort=Effort.FLEXIBLE)
        return
    planned.next_plan(GOAL, Q, effort=Effort.FLEXIBLE)
    (goals, _) = planner.requests[-1]
    assert goals[0] == replace(GOAL, release_height=GOAL.release_height + DROP)
    assert len(goals) > 1 and len(planner.requests) > 3, "after all that puts it down"


def test_grasps_of_what_nearly_fills_the_hand_come_after_those_at_any_angle(items):
    sure, doubtful = grasp(), grasp(DOUBTFUL - 0.1)
    planner = FakePlanner(items)
    planner.scene.found = GraspSet((sure, doubtful), Counter({"too wide": 3}))
    with pytest.raises(NoPlanError):
        planning(items, planner).next_plan(GOAL, Q, effort=Effort.FLEXIBLE)
    grasps = [used for _, used in planner.requests]
    only_sure = GraspSet((sure,), Counter({"too wide": 3}))
    assert grasps == [only_sure, only_sure, TILTED, None], "None: all of its shape"
    planner.requests.clear()
    with pytest.raises(NoPlanError):
        planning(items, planner).next_plan(GOAL, Q)
    assert [used for _, used in planner.requests] == [only_sure]


def test_a_bowl_goes_beside_the_one_below_only_when_nothing_else_helps(items):
    goal = Placement("can_1", GOAL.position, GOAL.yaws, ("bowl_2",), 0.05)
    for effort in (Effort.FLEXIBLE, Effort.CLEARING):
        planner = FakePlanner(items)
        with pytest.raises(NoPlanError):
            planning(items, planner).next_plan(goal, Q, effort=effort)
        assert all(g == goal for goals, _ in planner.requests for g in goals)
    planner = FakePlanner(items, lambda goals, grasps: goal not in goals)
    planning(items, planner).next_plan(goal, Q, effort=Effort.BESIDE)
    (goals, _) = planner.requests[-1]
    assert goals and all(g.stack == () for g in goals)


def nest(shapes, height=0.02, category="bowl", mesh=None):
    """A planner with a bowl in the cavity of another one, or on the table beside it."""
    found = [
        shapes.estimate(1, "bowl", shapes.bowl(0.08, 0.07), x=0.5, y=-0.2),
        shapes.estimate(2, category, mesh or shapes.bowl(0.05, 0.04), x=0.5, y=-0.2, lift=height),
    ]
    held = {estimate.name: to_standing(estimate) for estimate in found}
    return FakePlanner(held, lambda goals, grasps: grasps is TILTED)


def test_a_bowl_is_carried_with_the_bowl_in_it_if_nothing_else_is_possible(shapes):
    planner = nest(shapes)
    planner.feasible = lambda goals, grasps: bool(planner.contents[-1])
    goals = tuple(Placement(name, GOAL.position, GOAL.yaws) for name in planner.scene.items)
    task = TaskPlan("pack", planner.scene.items, goals, box=Box())
    with pytest.raises(NoPlanError):
        ObjectPlanning(task, planner, CONFIG).next_plan(goals[0], Q)
    ObjectPlanning(task, planner, CONFIG).next_plan(goals[0], Q, effort=Effort.FLEXIBLE)
    assert planner.contents[-1] == ("bowl_2",) and not any(planner.contents[:-1])
    planner.contents.clear()
    only = replace(task, placements=goals[:1])  # what is not to be packed is not carried along
    with pytest.raises(NoPlanError):
        ObjectPlanning(only, planner, CONFIG).next_plan(goals[0], Q, effort=Effort.FLEXIBLE)
    assert not any(planner.contents)


def test_only_upright_bowls_are_carried_in_a_bowl(shapes):
    assert nest(shapes).scene.bowls_in("bowl_1") == ("bowl_2",)
    assert nest(shapes).scene.bowls_in("bowl_2") == ()
    assert nest(shapes, height=0.2).scene.bowls_in("bowl_1") == ()
    assert nest(shapes, category="can", mesh=shapes.can(0.02, 0.06)).scene.bowls_in("bowl_1") == ()
    tipped = nest(shapes)
    tipped.scene.Ts["bowl_2"] = tipped.scene.Ts["bowl_2"].copy()
    tipped.scene.Ts["bowl_2"][:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    tipped.scene.Ts["bowl_2"][2, 3] = 0.06
    assert tipped.scene.bowls_in("bowl_1") == ()


def lying(items):
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[:3, 3] = 0.5, -0.3, 0.033
    planner = FakePlanner(items, lambda goals, grasps: grasps is not None)
    planner.scene.Ts["can_1"] = T
    return planner


def test_a_lying_object_is_turned_at_its_goal_or_on_free_table(items):
    planner = lying(items)
    with pytest.raises(PlanningError, match=r"can_1 lies on its side at \(0.50, -0.30\) m and cannot be"):
        planning(items, planner).next_plan(GOAL, Q)
    ((goals, _),) = planner.requests
    assert goals[0] is GOAL and len(goals) > 1 and all(goal.position[1] < 0.1 for goal in goals[1:])
    planning(items, planner).next_plan(GOAL, Q, effort=Effort.FLEXIBLE)
    assert planner.requests[-1][1] is TILTED


@pytest.mark.parametrize("far", [0.45, 0.0])
def test_what_lies_is_set_upright_where_it_can_be_taken_on(items, far):
    """Or anywhere, if that is nowhere within reach."""
    planner = lying(items)
    planner.within_reach = lambda position: position[0] < far
    with pytest.raises(PlanningError, match="lies on its side"):
        planning(items, planner).next_plan(GOAL, Q)
    ((goals, _),) = planner.requests
    assert len(goals) == 5 and goals[0] is GOAL
    assert all(goal.position[0] < far for goal in goals[1:]) is (far > 0)


def overturned(items, pickable):
    planner = lying(items)
    planner.scene.Ts["can_1"] = pose_from_yaw(0.0, np.array([0.5, -0.3, 0.1])) @ np.diag(
        [1.0, -1.0, -1.0, 1.0]
    )
    planner.pickable = pickable
    return planner


def test_what_is_upside_down_is_laid_where_it_can_be_grasped_again(items):
    """With the grasps of its pose there, and at the yaws at which it can be."""
    planner = overturned(items, lambda T: T[0, 3] < 0.45 and T[0, 2] > 0.9)  # the axis along +x
    with pytest.raises(PlanningError, match="stands upside down"):
        planning(items, planner).next_plan(GOAL, Q)
    ((goals, _),) = planner.requests
    assert goals
    for goal in goals:
        (yaw,) = goal.yaws
        T = planner.resting_pose(goal, yaw)
        assert T[0, 3] < 0.45 and T[0, 2] > 0.9
    T, grasps = planner.examined[0]
    up = grasps.grasps[0].T_stand_tcp[:3, 2] @ T[:3, :3].T  # approach of the hand, in the world
    assert grasps.grasps and up[2] < -0.9


def test_it_is_laid_anyhow_where_it_can_be_grasped_nowhere(items):
    planner = overturned(items, lambda T: False)
    with pytest.raises(PlanningError, match="stands upside down"):
        planning(items, planner).next_plan(GOAL, Q)
    ((goals, _),) = planner.requests
    assert goals and all(len(goal.yaws) > 4 for goal in goals)


def test_places_to_lay_it_are_examined_once_in_a_scene(items):
    planner = overturned(items, lambda T: T[0, 3] < 0.45)
    planned = planning(items, planner)
    counts, states = [], (SceneState(), SceneState())
    for state in (0, 0, 1):
        planner.scene.state = states[state]
        with pytest.raises(PlanningError, match="stands upside down"):
            planned.next_plan(GOAL, Q, effort=Effort.PLAIN)
        counts.append(len(planner.examined))
    assert counts[0] == counts[1] == counts[2] / 2 > 0


def test_what_lies_is_set_aside_where_it_can_be_turned(items):
    planner = lying(items)
    planner.pickable = lambda T: T[0, 3] < 0.45
    assert next(planning(items, planner).plans_aside(("can_1",), {"can_1"}, Q)).name == "can_1"
    ((goals, _),) = planner.requests
    assert goals and all(planner.resting_pose(goal, goal.yaws[0])[0, 3] < 0.45 for goal in goals)


def test_an_object_without_a_grasp_is_reported_with_its_pose(items):
    planner = lying(items)
    planner.scene.Ts["can_1"] = items["can_1"].T_world_stand @ np.diag([1.0, -1.0, -1.0, 1.0])
    planner.scene.found = GraspSet((), Counter())
    with pytest.raises(PlanningError, match=r"can_1 stands upside down at .*turn it over by hand"):
        planning(items, planner).next_plan(GOAL, Q)


def test_a_blocker_is_set_aside_in_its_orientation_if_it_may_be_moved(items):
    planner = FakePlanner(items, lambda goals, grasps: grasps is not None)
    aside = planning(items, planner).plans_aside(("thing_0", "bowl_2"), {"bowl_2"}, Q)
    plan = next(aside)
    assert plan.name == "bowl_2"
    ((goals, grasps),) = planner.requests
    assert grasps is KEEPING
    for goal in goals:
        np.testing.assert_allclose(goal.T_goal_stand[:3, :3], np.eye(3), atol=1e-9)
        apart = np.linalg.norm(np.subtract(goal.position[:2], items["can_1"].T_world_stand[:2, 3]))
        assert apart > 0.08, "clear of the others"
    assert not list(aside)
    assert not list(planning(items, planner).plans_aside(("thing_0", "can_1"), {"bowl_2"}, Q))


AT_GOAL = pose_from_yaw(0.0, np.array(GOAL.position))


class Blocked(FakePlanner):
    """A planner for which ``needed`` must be absent; ``blockers`` lists what is met first.

    The plan that it finds without all of them is blocked by each of ``also``.
    """

    needed, blockers = frozenset({"bowl_2"}), ("bowl_2", "mug_3", "table")
    also: frozenset[str] = frozenset()

    def __init__(self, items):
        super().__init__(items)
        self.asked, self.free = [], ()  # places that were examined, and the x of those that are free

    def plan(self, goals, q, tried=(), grasps=None, contents=()):
        self.requests.append((goals, grasps))
        needed = self.needed
        if grasps is not None and grasps.grasps[0] is FOUND:
            assert goals is GOAL, "the place of the plan that was found"
            needed |= self.also
        if needed <= self.scene.absent:
            plan = object.__new__(PickPlacePlan)
            plan.__dict__.update(
                name="can_1", grasp=FOUND, placement=GOAL, contents=(), T_world_stand_rest=AT_GOAL
            )
            return plan
        raise NoPlanError("No plan", tuple(name for name in self.blockers if name not in self.scene.absent))

    def can_place_after(self, placement, before):
        assert self.scene.Ts["can_1"] is AT_GOAL and placement.name not in self.scene.absent and not before
        self.asked.append(placement)
        return placement.position[0] in self.free


@pytest.mark.parametrize(
    ("needed", "movable", "expected"),
    [
        ({"bowl_2"}, {"bowl_2", "mug_3"}, {"bowl_2"}),
        ({"bowl_2", "mug_3"}, {"bowl_2", "mug_3"}, {"bowl_2", "mug_3"}),
        ({"bowl_2", "mug_3"}, {"bowl_2"}, set()),
        ({"table"}, {"bowl_2", "mug_3"}, set()),
        (set(), {"bowl_2"}, set()),
    ],
)
def test_what_is_moved_for_an_object_is_what_it_needs_and_nothing_if_that_does_not_help(
    items, needed, movable, expected
):
    planner = Blocked(items)
    planner.needed = frozenset(needed)
    planned = planning(items, planner)
    assert planned.in_the_way(GOAL, Q, (), Effort.CLEARING, movable) == expected
    assert not planner.scene.absent


def test_what_blocks_the_plan_that_was_found_alone_is_not_moved(items):
    planner = Blocked(items)
    planner.needed, planner.also = frozenset({"mug_3"}), frozenset({"bowl_2"})
    planned = planning(items, planner)
    assert planned.in_the_way(GOAL, Q, (), Effort.CLEARING, {"bowl_2", "mug_3"}) == {"mug_3"}


@pytest.mark.parametrize(
    ("free", "elsewhere", "expected"),
    [((), (), set()), ((0.45,), (), {"bowl_2"}), ((0.5,), (0.5,), {"bowl_2"}), ((), (0.5,), set())],
)
def test_what_is_in_its_place_is_moved_only_if_it_has_one_afterwards(
    items, monkeypatch, free, elsewhere, expected
):
    """At its goal or elsewhere, once the object is at its own; with it, all stay where they are."""
    own = Placement("bowl_2", (0.45, 0.3, 0.0), (0.0,))
    others = [replace(own, position=(x, 0.3, 0.0)) for x in elsewhere]
    planner = Blocked(items)
    planner.free = free
    planned = planning(items, planner)
    monkeypatch.setattr(open_places, "free_places", lambda *_, **__: others)
    movable = {"bowl_2", "mug_3"}
    assert planned.in_the_way(GOAL, Q, (), Effort.PLAIN, movable, {"bowl_2": own}) == expected
    assert planner.asked and planner.scene.Ts["can_1"] is not AT_GOAL
    planner.asked.clear()
    assert planned.in_the_way(GOAL, Q, (), Effort.PLAIN, movable, {"mug_3": own}) == {"bowl_2"}
    assert not planner.asked, "only what is moved has to be put back"


def test_what_does_not_block_the_plan_that_was_found_costs_no_further_search(items):
    planner = Blocked(items)
    planner.needed = frozenset({"bowl_2"})
    planning(items, planner).in_the_way(GOAL, Q, (), Effort.PLAIN, {"bowl_2", "mug_3"})
    full = [grasps for _, grasps in planner.requests if grasps is None or grasps.grasps[0] is not FOUND]
    assert len(full) == 2, "with all there, and without both"


def test_what_cannot_be_set_aside_is_not_tried_again_in_the_same_scene(items):
    planner = FakePlanner(items, lambda goals, grasps: False)
    planned = planning(items, planner)
    for _ in range(2):
        assert not list(planned.plans_aside(("bowl_2",), {"bowl_2"}, Q))
    assert len(planner.requests) == 1
    planner.scene.state = SceneState()
    assert not list(planned.plans_aside(("bowl_2",), {"bowl_2"}, Q)) and len(planner.requests) == 2


def test_what_failed_is_remembered_while_plans_without_some_objects_are_made(items):
    planner = FakePlanner(items)
    planned = planning(items, planner)

    def attempt():
        with pytest.raises(NoPlanError):
            planned.next_plan(GOAL, Q)

    attempt()
    first = len(planner.requests)
    with planner.scene.without({"bowl_2"}):
        attempt()
    assert len(planner.requests) == 2 * first
    attempt()
    assert len(planner.requests) == 2 * first, "back in the scene of before"


def test_a_push_that_does_not_help_is_not_planned_again_in_the_same_scene(items, monkeypatch):
    asked = []
    monkeypatch.setattr(object_planning, "plan_push", lambda *_: asked.append(1))
    planner = FakePlanner(items, lambda goals, grasps: False)
    planned = planning(items, planner)
    assert planned.push("can_1", Q) is None and planned.push("can_1", Q) is None and len(asked) == 1
    planner.scene.state = SceneState()
    assert planned.push("can_1", Q) is None and len(asked) == 2


def test_nothing_is_pushed_in_the_box(items, monkeypatch):
    push = object.__new__(Push)
    monkeypatch.setattr(object_planning, "plan_push", lambda *_: push)
    planner = FakePlanner(items, lambda goals, grasps: False)
    assert planning(items, planner).push("can_1", Q) is push
    planner.scene.Ts["can_1"] = pose_from_yaw(0.0, np.array([*GOAL.position[:2], 0.0]))
    assert planning(items, planner).push("can_1", Q) is None
