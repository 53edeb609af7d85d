"""Where objects may stand, by what is in the box and on the rows already."""

import numpy as np
import pytest

from manipulation.collision import CollisionConfig
from manipulation.open_places import OpenPlaces
from manipulation.planner import ManipulationConfig
from manipulation.planning_scene import PlanningScene
from manipulation.standing import to_standing
from manipulation.types import Box, Line, Placement, TaskPlan
from perception.geometry import pose_from_yaw

CONFIG = ManipulationConfig()
GOAL = Placement("can_1", (*Box().center, Box().floor), (0.0,))


@pytest.fixture(scope="module")
def items(shapes):
    found = [
        shapes.estimate(1, "can", shapes.can(), x=0.55, y=-0.2),
        shapes.estimate(2, "bowl", shapes.bowl(), x=0.4, y=-0.15),
    ]
    return {estimate.name: to_standing(estimate) for estimate in found}


@pytest.fixture
def scene_of(arm):
    grasp = CONFIG.pick_place.grasp
    return lambda items: PlanningScene(arm, items, (), CollisionConfig(), grasp)


def put(scene, T, *names):
    for name in names:
        scene.moved(name, T)


def test_what_stands_in_the_box_may_be_moved_and_put_back(items, scene_of):
    """But bowls, which may hold something, what lies there, and what has another goal."""
    scene = scene_of(items)
    places = OpenPlaces(TaskPlan("pack", items, (GOAL,), box=Box()), scene, CONFIG)
    assert places.in_place(()) == {}, "both are on the table"
    T = pose_from_yaw(0.4, np.array([*GOAL.position[:2], 0.005]))
    put(scene, T, "can_1", "bowl_2")
    (goal,) = places.in_place(()).values()
    assert goal.name == "can_1" and goal.position == (*GOAL.position[:2], Box().floor) and goal.stack == ()
    assert goal.yaws[0] == pytest.approx(0.4) and goal.release_height == CONFIG.packing.release_height
    assert places.in_place(("can_1",)) == {}
    put(scene, T @ np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]), "can_1")
    assert places.in_place(()) == {}
    task = TaskPlan("sort", items, (GOAL,), box=Box())
    put(scene, T, "can_1")
    assert OpenPlaces(task, scene, CONFIG).in_place(()) == {}, "the box is an obstacle"


def test_what_stands_on_a_row_may_be_moved_and_put_back(items, scene_of):
    scene = scene_of(items)
    places = OpenPlaces(TaskPlan("sort", items, (GOAL,), lines=(Line(),)), scene, CONFIG)
    assert places.in_place(()) == {}, "both are beside it"
    x, y = np.array(Line().start) + 0.3 * Line().direction
    put(scene, pose_from_yaw(0.4, np.array([x, y, 0.002])), "can_1", "bowl_2")
    goals = places.in_place(("can_1",))
    assert goals.keys() == {"bowl_2"} and goals["bowl_2"].position == pytest.approx((x, y, 0.0))
    assert goals["bowl_2"].release_height == CONFIG.sorting.release_height


def test_what_is_taken_is_the_top_view_of_everything_else_that_is_known(items, scene_of):
    scene = scene_of(items)
    places = OpenPlaces(TaskPlan("pack", items, (GOAL,), box=Box()), scene, CONFIG)
    (outline,) = places.taken("can_1")
    assert outline.mean(axis=0) == pytest.approx((0.4, -0.15), abs=2e-3)
    scene.forget("bowl_2")
    assert places.taken("can_1") == []
