import itertools
from dataclasses import replace

import numpy as np
import pytest

from manipulation import pick_place
from manipulation.candidates import Tally
from manipulation.collision import AllowedContacts
from manipulation.errors import PlanningError
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, Obstacle
from manipulation.pick_place import PickPlaceConfig, PickPlacePlanner
from manipulation.pick_place_segments import Pick
from manipulation.robot import JointTrajectory
from manipulation.standing import to_standing
from manipulation.trajectories import MotionConfig
from manipulation.types import PickPlacePlan, Placement

CONFIG = PickPlaceConfig(
    max_plans=1,
    motion=MotionConfig(line_step=0.03),
    grasp=GraspConfig(n_azimuths=4, top_depths=(0.02,)),
)
# Between can and goal. At the height of the lift the hand passes above the wall, but the can does not.
WALL = Obstacle("wall", (0.5, 0.0, 0.125), (0.25, 0.02, 0.125))
HIGH_WALL = Obstacle("wall", (1.25, 0.0, 0.75), (1.0, 0.01, 0.75))
CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
GOAL = Placement("can_1", (0.5, 0.25, 0.0), (0.0,))


@pytest.fixture(scope="module")
def kinematics(arm):
    return Kinematics(arm)


@pytest.fixture(scope="module")
def items(shapes):
    estimates = [
        shapes.estimate(1, "can", shapes.can(), x=0.5, y=-0.25),
        shapes.estimate(2, "bowl", shapes.bowl(0.075, slope=0.3), x=0.3, y=-0.4),
        shapes.estimate(3, "bowl", shapes.bowl(0.055, 0.045, slope=0.3), x=0.6, y=-0.4),
    ]
    return {item.name: item for item in map(to_standing, estimates)}


def posture(kinematics, x, y, z):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, y, z
    return kinematics.inverse(T, kinematics.seeds_toward(T)).q


@pytest.mark.slow
def test_transit_avoids_obstacles_with_the_hand_and_the_carried_object(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, (TABLE, WALL), CONFIG)
    plan = planner.plan(GOAL, posture(kinematics, 0.5, 0.2, 0.2))
    world, margin = planner.scene.world, CONFIG.transit_margins[-1]
    touch_can = AllowedContacts(frozenset({"can_1"}), robot_margin=0.9 * margin)
    assert world.path_contact(plan.approach.positions[::20], plan.grasp.opening, touch_can) is None
    world.carry("can_1", np.linalg.inv(plan.grasp.T_stand_tcp))
    lifted = np.concatenate([plan.carry.positions, plan.lowering.positions])[::20]
    assert world.path_contact(lifted, plan.grasp.held_width, AllowedContacts(carried_margin=0.0)) in (
        None, world.contact(lifted[-1], plan.grasp.held_width, AllowedContacts(carried_margin=0.0)),
    )  # fmt: skip
    crossing = np.abs([kinematics.forward(q)[1, 3] for q in lifted]) < 0.1
    assert crossing.any()
    assert world.path_contact(lifted[crossing], plan.grasp.held_width) is None


@pytest.mark.slow
def test_an_obstacle_that_cannot_be_avoided_is_the_reason(kinematics, items):
    first_only = replace(CONFIG, max_pairs=0, via_heights=(0.4,), transit_margins=(0.004,))
    planner = PickPlacePlanner(kinematics, items, (TABLE, HIGH_WALL), first_only)
    q_near, q_far = posture(kinematics, 0.4, -0.25, 0.3), posture(kinematics, 0.4, 0.25, 0.3)
    with pytest.raises(PlanningError, match=r"No plan for can_1: of \d+ .*path to the goal.*; clear"):
        planner.plan(GOAL, q_near)
    here = Placement("can_1", (0.55, -0.2, 0.0), (0.0,))
    with pytest.raises(PlanningError, match=r"\d+ without a collision-free path to the object"):
        planner.plan(here, q_far)
    assert planner.plan(here, q_near).name == "can_1"


def test_no_candidate_within_reach_suggests_to_move_the_object(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    far = planner.scene.pose("can_1")
    far[:2, 3] = 1.2, 0.0
    planner.scene.moved("can_1", far)
    with pytest.raises(PlanningError, match=r"of 4 candidates, 4 out of reach; move it closer to the arm"):
        planner.plan(GOAL, kinematics.arm.q_home)


def plan_of(duration):
    """Return a plan of which only the durations of the motions are set."""

    def still(steps):
        zeros = np.zeros((steps + 1, 7))
        return JointTrajectory(1.0, zeros, zeros, zeros)

    plan = object.__new__(PickPlacePlan)
    object.__setattr__(plan, "approach", still(int(duration)))
    for name in ("lift", "carry", "lowering", "retreat"):
        object.__setattr__(plan, name, still(0))
    object.__setattr__(plan, "settle", None)
    object.__setattr__(plan, "transit", None)
    return plan


@pytest.mark.parametrize(
    ("scores", "duration"),
    [((1.0, 1.0, 1.0, 0.98, 0.98), 2.0), ((1.0, 1.0, 0.9, 0.9, 0.9), 3.0)],
)
def test_the_shortest_plan_of_grasps_that_are_as_good_is_returned(
    kinematics, items, monkeypatch, scores, duration
):
    """At most three plans are compared, none of a grasp whose score is much lower than that of the first."""
    planner = PickPlacePlanner(kinematics, items, config=PickPlaceConfig(grasp=CONFIG.grasp, max_plans=3))
    plans = iter([plan_of(3.0), None, plan_of(2.0), plan_of(4.0), plan_of(1.0)])
    scored = planner.scene.grasps("can_1").grasps[0]
    still = np.zeros((1, 7))
    picks = [Pick(replace(scored, score=score), still, still) for score in scores]
    monkeypatch.setattr(planner, "_picks", lambda *_: iter(picks))
    monkeypatch.setattr(planner, "_complete", lambda *_: next(plans))
    assert planner.plan(GOAL, kinematics.arm.q_home).duration == duration


def test_similar_grasps_are_not_tried_again(kinematics, items):
    config = PickPlaceConfig(grasp=GraspConfig(n_azimuths=24, top_depths=(0.02, 0.022, 0.03)))
    planner = PickPlacePlanner(kinematics, items, config=config)
    first = planner.scene.grasps("can_1").grasps[0]
    for pick, _ in zip(planner._picks("can_1", planner.scene.grasps("can_1"), [first], Tally()), range(4)):
        turn = np.abs(np.angle(np.exp(1j * (pick.grasp.azimuth - first.azimuth))))
        assert turn >= np.deg2rad(20) or abs(pick.grasp.depth - first.depth) >= 0.003


def test_a_grasp_is_examined_once_as_long_as_nothing_moves(kinematics, items, monkeypatch):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    examined, find_pick = [], pick_place.find_pick

    def find(motions, name, grasp, config):
        examined.append(grasp)
        return find_pick(motions, name, grasp, config)

    monkeypatch.setattr(pick_place, "find_pick", find)
    T, grasps = planner.scene.pose("can_1"), planner.scene.grasps("can_1")

    def picks():
        examined.clear()
        tally = Tally()
        found = []
        for pick in planner._picks("can_1", grasps, (), tally):
            assert planner.scene.world.contact(pick.lift[-1], pick.grasp.held_width) is None
            assert planner.scene.world.carried_overlaps(pick.lift[0], pick.grasp.held_width), (
                "it is in the hand"
            )
            found.append(pick)
        planner.scene.world.release()
        return found, tally

    first, tally = picks()
    assert first and len(examined) == len(grasps.grasps)
    again, same_tally = picks()
    assert not examined and all(a is b for a, b in zip(first, again, strict=True))
    assert same_tally == tally
    T_far = T.copy()
    T_far[0, 3] += 1.0
    assert not planner.can_pick("can_1", T_far) and len(examined) == len(grasps.grasps)
    with planner.scene.without(["bowl_2"]):
        picks()
        assert len(examined) == len(grasps.grasps), "without something there may be more"
    picks()
    assert not examined
    planner.scene.moved("can_1", T)
    picks()
    assert len(examined) == len(grasps.grasps)


def test_resting_pose_is_at_the_yaw_and_raised_by_the_stack(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    floor = planner.resting_pose(Placement("bowl_3", (0.5, 0.3, 0.004), (0.5,)), 0.5)
    np.testing.assert_allclose(floor[:3, 3], (0.5, 0.3, 0.004))
    assert np.arctan2(floor[1, 0], floor[0, 0]) == pytest.approx(0.5)
    nested = planner.resting_pose(Placement("bowl_3", (0.5, 0.3, 0.004), (0.5,), stack=("bowl_2",)), 0.5)
    assert nested[2, 3] == pytest.approx(0.004 + 0.005, abs=0.003)


def test_resting_pose_of_an_object_to_be_laid_down(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (-0.06, 0.0, 0.03)
    laid = planner.resting_pose(Placement("can_1", (0.5, -0.2, 0.0), (np.pi / 2,), T_goal_stand=T), np.pi / 2)
    np.testing.assert_allclose(laid[:3, 3], (0.5, -0.26, 0.03), atol=1e-12)
    np.testing.assert_allclose(laid[:3, 2], (0.0, 1.0, 0.0), atol=1e-12)


def test_the_first_feasible_of_several_goals_is_taken(kinematics, items, arm):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    far, near = (Placement("can_1", (x, 0.25, 0.0), (0.0,)) for x in (1.5, 0.5))
    plan = planner.plan((far, near), np.array(arm.q_home))
    assert plan.placement is near


@pytest.mark.slow
def test_a_standing_object_is_grasped_at_an_angle_on_request(kinematics, items, arm):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    placement = Placement("can_1", (0.5, 0.25, 0.0), (0.0,))
    q = np.array(arm.q_home)
    assert planner.plan(placement, q).grasp.kind == "top"
    assert (
        planner.plan(placement, q, grasps=planner.scene.tilted_grasps(placement.name)).grasp.kind
        == "antipodal"
    )
    assert planner.scene.tilted_grasps("can_1") is planner.scene.tilted_grasps("can_1")


@pytest.mark.parametrize(("x", "expected"), [(0.5, False), (0.3, True)])
def test_whether_a_place_stays_free_behind_another_object(kinematics, items, x, expected):
    planner = PickPlacePlanner(kinematics, items, (TABLE,), CONFIG)
    start = planner.scene.pose("bowl_2")
    assert planner.can_place_after(GOAL, [Placement("bowl_2", (x, 0.25, 0.0), (0.0,))]) is expected
    assert planner.scene.pose("bowl_2") == pytest.approx(start)
    assert planner.scene.pose("can_1") == pytest.approx(items["can_1"].T_world_stand)


def test_a_forgotten_object_stays_forgotten_when_its_place_is_examined(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, (TABLE,), CONFIG)
    over_can = posture(kinematics, 0.5, -0.25, 0.06)
    planner.scene.forget("can_1")
    assert planner.can_place_after(GOAL, [Placement("bowl_2", (0.5, 0.25, 0.0), (0.0,))])
    assert planner.scene.world.contact(over_can, 0.08) is None


@pytest.mark.slow
def test_an_object_is_lifted_out_of_the_bowl_that_holds_it(kinematics, shapes, arm):
    """With fingers below the rim, where the bowl's hull would be in their way."""
    estimates = [
        shapes.estimate(1, "can", shapes.can(0.02, 0.06), x=0.5, y=-0.25, lift=0.008),
        shapes.estimate(2, "bowl", shapes.bowl(0.085, 0.07), x=0.5, y=-0.25),
    ]
    inside = {item.name: item for item in map(to_standing, estimates)}
    planner = PickPlacePlanner(kinematics, inside, config=CONFIG)
    plan = planner.plan(GOAL, np.array(arm.q_home))
    assert (planner.scene.pose("can_1") @ plan.grasp.T_stand_tcp)[2, 3] < 0.06


def test_motions_are_checked_among_the_obstacles_that_were_seen_last(kinematics, items):
    planner = PickPlacePlanner(kinematics, items, config=CONFIG)
    before = planner.motions
    planner.scene.observe_obstacles([])
    assert planner.motions is not before and planner.motions.world is planner.scene.world
    assert planner.motions is planner.motions
