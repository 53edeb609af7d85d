"""Plans that are made ahead: used in the scene that they were made for, and in no other."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import NoPlanError
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import Kinematics
from manipulation.obstacles import TABLE, box_obstacles
from manipulation.packing_problem import PackingConfig
from manipulation.pick_place import PickPlaceConfig, PickPlacePlanner
from manipulation.planner import ManipulationConfig, plan_pack
from manipulation.planning_ahead import PlanningAhead, Snapshot
from manipulation.trajectories import MotionConfig
from manipulation.types import Box
from perception.obstacles.obstacle import PerceivedObstacle

CONFIG = ManipulationConfig(  # coarser than the defaults, for speed alone
    pick_place=PickPlaceConfig(
        max_plans=1, motion=MotionConfig(line_step=0.03), grasp=GraspConfig(n_azimuths=8, top_depths=(0.03,))
    ),
    packing=PackingConfig(gaps=(0.012,), n_handle_directions=2),
)


@pytest.fixture(scope="module")
def task(shapes, arm):
    scene = [
        shapes.estimate(1, "can", shapes.can(), x=0.55, y=-0.2),
        shapes.estimate(2, "can", shapes.can(), x=0.42, y=-0.2),
    ]
    return plan_pack(scene, Box(), arm, CONFIG)


@pytest.fixture
def planner(task, arm):
    obstacles = (TABLE, *box_obstacles(task.box))
    return PickPlacePlanner(Kinematics(arm), task.objects, obstacles, CONFIG.pick_place, task.grasps)


@pytest.fixture(scope="module")
def present(task, arm):
    obstacles = (TABLE, *box_obstacles(task.box))
    planner = PickPlacePlanner(Kinematics(arm), task.objects, obstacles, CONFIG.pick_place, task.grasps)
    return planner.plan(task.placements[0], np.asarray(arm.q_home))


@pytest.fixture
def ahead(task, planner):
    with PlanningAhead(task, planner, CONFIG) as ahead:
        yield ahead


def end(plan):
    return plan.retreat.positions[-1]


def test_a_plan_made_ahead_is_the_one_that_would_be_made_afterwards(task, planner, ahead, present):
    following = task.placements[1]
    ahead.begin(present, following)
    planner.scene.moved(present.name, present.T_world_stand_rest)
    plan = ahead.take(following, end(present))
    assert plan is not None and plan.name == following.name
    again = planner.plan(following, end(present))
    assert plan.grasp == again.grasp
    np.testing.assert_allclose(plan.transit.positions, again.transit.positions, atol=1e-6)
    np.testing.assert_allclose(plan.lowering.positions, again.lowering.positions, atol=1e-6)
    assert ahead.take(following, end(present)) is None, "it is used once"


def test_the_scene_itself_is_not_changed_by_planning_ahead(task, planner, ahead, present):
    before = Snapshot.of(planner.scene)
    ahead.begin(present, task.placements[1])
    assert Snapshot.of(planner.scene).is_same(before)
    assert not before.after(present).is_same(before)


def elsewhere(task, planner, present, q):
    planner.scene.moved(present.name, present.T_world_stand_rest @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    return task.placements[1], q


def another_moved(task, planner, present, q):
    T = planner.scene.pose(task.placements[1].name)
    T[0, 3] += 1e-3
    planner.scene.moved(task.placements[1].name, T)
    return task.placements[1], q


def forgotten(task, planner, present, q):
    planner.scene.forget(task.placements[1].name)
    return task.placements[1], q


def new_obstacle(task, planner, present, q):
    corners = np.array(list(itertools.product((0.70, 0.72), (-0.40, -0.38), (0.0, 0.02))))
    planner.scene.observe_obstacles([PerceivedObstacle(0, (corners,), 100)])
    return task.placements[1], q


def another_posture(task, planner, present, q):
    return task.placements[1], q + 0.02


def another_goal(task, planner, present, q):
    x, y, z = task.placements[1].position
    return replace(task.placements[1], position=(x, y + 0.001, z)), q


@pytest.mark.parametrize(
    "change", [elsewhere, another_moved, forgotten, new_obstacle, another_posture, another_goal]
)
def test_a_plan_is_dropped_where_something_else_happened(task, planner, ahead, present, change):
    ahead.begin(present, task.placements[1])
    planner.scene.moved(present.name, present.T_world_stand_rest)
    placement, q = change(task, planner, present, end(present).copy())
    assert ahead.take(placement, q) is None


def test_a_measured_posture_near_the_planned_one_will_do(task, planner, ahead, present):
    ahead.begin(present, task.placements[1])
    planner.scene.moved(present.name, present.T_world_stand_rest)
    assert ahead.take(task.placements[1], end(present) + 0.005) is not None


def test_that_there_is_no_plan_is_known_ahead_as_well(task, planner, ahead, present):
    x, y, z = task.placements[1].position
    far = replace(task.placements[1], position=(x + 3.0, y, z))
    ahead.begin(present, far)
    planner.scene.moved(present.name, present.T_world_stand_rest)
    with pytest.raises(NoPlanError, match="out of reach"):
        ahead.take(far, end(present))


def test_nothing_is_planned_where_nothing_follows(task, planner, ahead, present):
    ahead.begin(present, task.placements[1])
    ahead.begin(present, None)
    planner.scene.moved(present.name, present.T_world_stand_rest)
    assert ahead.take(task.placements[1], end(present)) is None


def test_forgotten_objects_are_not_in_the_way_of_a_plan_made_ahead(task, arm, planner, present):
    """A can of unknown pose stands at the goal as far as the planner knows its last pose."""
    first, second = task.placements
    blocking = planner.resting_pose(second, 0.0)
    planner.scene.moved(first.name, blocking)
    planner.scene.forget(first.name)
    with PlanningAhead(task, planner, CONFIG) as ahead:
        carried = replace(present, name=second.name, T_world_stand_rest=planner.scene.pose(second.name))
        ahead.begin(carried, second)
        assert ahead.take(second, end(present)) is not None
