from dataclasses import replace

import numpy as np
import pytest

from manipulation import planner
from manipulation.errors import PlanningError
from manipulation.grasp_config import GraspConfig
from manipulation.kinematics import Kinematics
from manipulation.packing_problem import PackingConfig
from manipulation.pick_place import PickPlaceConfig
from manipulation.planner import ManipulationConfig, plan_pack, plan_sort
from manipulation.robot import GripperGeometry
from manipulation.sorting_rows import Rows
from manipulation.types import Box, Line

# Coarser than the defaults, for speed alone.
CONFIG = ManipulationConfig(
    pick_place=PickPlaceConfig(grasp=GraspConfig(n_azimuths=8, top_depths=(0.02, 0.03))),
    packing=PackingConfig(gaps=(0.012,), n_handle_directions=2),
)


@pytest.fixture(scope="module")
def scene(shapes):
    return [
        shapes.estimate(1, "can", shapes.can(), x=0.55, y=-0.2),
        shapes.estimate(2, "bowl", shapes.bowl(), x=0.4, y=-0.15),
    ]


def test_unreachable_object_is_named_and_left_out(scene, shapes, arm):
    far = shapes.estimate(9, "can", shapes.can(), x=1.05, y=0.1)
    task = plan_pack([scene[0], far], Box(), arm, CONFIG)
    assert task.left_out == {"can_9": "can_9 at (1.05, 0.10) m is out of the arm's reach; move it closer"}
    assert "can_9" in task.objects and all(p.name != "can_9" for p in task.placements)
    with pytest.raises(PlanningError, match="none of 1 objects can be manipulated: can_9"):
        plan_pack([far], Box(), arm, CONFIG)


def test_nothing_perceived_is_an_error(arm):
    with pytest.raises(PlanningError, match="no object was perceived: repeat the scan"):
        plan_sort([], Line(), arm)


def test_grasps_are_planned_for_the_arms_own_gripper(arm, shapes):
    """A can too wide for the usual hand is taken by an arm whose hand opens wider."""
    wide = [shapes.estimate(1, "can", shapes.can(radius=0.044))]
    with pytest.raises(PlanningError, match=r"too wide for 0\.08 m"):
        plan_pack(wide, Box(), arm)
    plan = plan_pack(wide, Box(), replace(arm, gripper=GripperGeometry(max_width=0.1)))
    assert [placement.name for placement in plan.placements] == ["can_1"] and not plan.left_out


def test_configuration_for_an_arm_has_its_gripper(arm):
    hand = GripperGeometry(max_width=0.11)
    config = CONFIG.for_arm(replace(arm, gripper=hand))
    assert config.pick_place.grasp == replace(CONFIG.pick_place.grasp, gripper=hand)
    assert config.packing == CONFIG.packing


def test_an_arm_of_five_joints_keeps_its_hand_vertical(arm):
    grasp = CONFIG.for_arm(replace(arm, joint_names=arm.joint_names[:5])).pick_place.grasp
    assert (grasp.max_tilt, grasp.max_inward_tilt) == (0, 0)


def test_plans_hold_all_objects_their_grasps_and_the_goal_geometry(scene, shapes, arm):
    wide = shapes.estimate(5, "can", shapes.can(radius=0.05), x=0.4, y=-0.4)
    kinematics = Kinematics(arm)
    packing = plan_pack([*scene, wide], Box(), arm, CONFIG, kinematics)
    assert packing.task == "pack" and packing.box == Box() and packing.lines == ()
    assert set(packing.objects) == set(packing.grasps) == {"can_1", "bowl_2", "can_5"}
    assert packing.left_out == {"can_5": packing.grasps["can_5"].failure_message("can_5")}
    assert packing.grasps["can_1"].grasps and not packing.grasps["can_5"].grasps
    sorting = plan_sort(scene, Line(), arm, CONFIG, Box(), kinematics)
    assert sorting.task == "sort" and sorting.lines == (Line(),) and sorting.box == Box()
    assert {placement.name for placement in sorting.placements} == {"can_1", "bowl_2"}
    assert plan_sort(scene, Line(), arm, CONFIG).box is None


def test_the_plan_has_the_rows_in_the_order_in_which_they_are_filled(scene, arm, monkeypatch):
    near = Line((0.32, 0.15), (-0.1, 0.38))
    rows = Rows((), {}, (near, Line()))
    monkeypatch.setattr(planner, "sort_rows", lambda *_: rows)
    assert plan_sort(scene, Line(), arm, CONFIG).lines == (near, Line())


def test_objects_that_do_not_stand_are_planned_where_they_can_be_turned(scene, arm):
    """They are turned first; their goals are as those of any other. An overturned bowl lies on no side."""
    on_side, over = (scene[0].T_world_object.copy() for _ in range(2))
    on_side[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    on_side[2, 3] = 0.033
    packing = plan_pack([replace(scene[0], T_world_object=on_side), scene[1]], Box(), arm, CONFIG)
    assert {placement.name for placement in packing.placements} == {"can_1", "bowl_2"}
    over[:3, :3] = np.diag([1.0, -1, -1])
    bowl_over = scene[1].T_world_object @ np.diag([1.0, -1, -1, 1])
    scene = [replace(scene[0], T_world_object=over), replace(scene[1], T_world_object=bowl_over)]
    packing = plan_pack(scene, Box(), arm, CONFIG)
    assert {placement.name for placement in packing.placements} == {"can_1"}
    assert packing.left_out["bowl_2"].startswith("bowl_2 stands upside down at")
    assert packing.left_out["bowl_2"].endswith("turn it over by hand")


def test_what_others_rest_on_is_packed_after_them(shapes, arm):
    """The place of the bowl is one that the hand reaches beside all others."""
    bowl = shapes.estimate(1, "bowl", shapes.bowl(), x=0.5, y=-0.2)
    can = shapes.estimate(2, "can", shapes.can(0.025, 0.08), x=0.5, y=-0.2)
    alone = plan_pack([bowl, can], Box(), arm, CONFIG)
    assert [goal.name for goal in alone.placements] == ["bowl_1", "can_2"]
    stacked = plan_pack([bowl, replace(can, rests_on=1)], Box(), arm, CONFIG)
    assert [goal.name for goal in stacked.placements] == ["can_2", "bowl_1"]
