"""Goals in a box that holds others: clear of them, aligned, nested."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import PlanningError
from manipulation.further_packing import loose_bowl, plan_further
from manipulation.nesting import nest_heights
from manipulation.standing import to_standing
from manipulation.types import Box
from perception.geometry import pose_from_yaw
from tests.manipulation.test_planner import CONFIG

BOX = Box()


def in_box(estimate, x=0.0, y=0.0, yaw=0.0, z=BOX.floor):
    item = to_standing(estimate)
    place = np.array([BOX.center[0] + x, BOX.center[1] + y, z])
    return {item.name: replace(item, T_world_stand=pose_from_yaw(yaw, place))}


def test_a_can_gets_a_place_clear_of_what_is_there(shapes, arm):
    placed = in_box(shapes.estimate(1, "can", shapes.can()))
    cans = [shapes.estimate(i, "can", shapes.can(), x=0.4 + 0.06 * i, y=-0.3) for i in (2, 3)]
    plan = plan_further(cans, placed, BOX, arm, CONFIG)
    assert [p.name for p in plan.placements] == ["can_2", "can_3"] and not plan.left_out
    places = np.array([(*BOX.center,), *(p.position[:2] for p in plan.placements)])
    apart = np.linalg.norm(places[:, None] - places, axis=-1) + np.eye(3)
    assert apart.min() > 2 * 0.033 + 0.005
    assert "can_1" in plan.objects and plan.placements[0].position[2] == BOX.floor


@pytest.mark.parametrize("side", [-1, 1])
def test_the_hand_has_room_where_an_object_is_placed(shapes, arm, monkeypatch, side):
    count = lambda raster, grasps, pose, gripper: int(len(grasps) and side * pose.position[0] > 0.02)  # noqa: E731
    monkeypatch.setattr("manipulation.free_places.count_free_releases", count)
    (goal,) = plan_further(
        [shapes.estimate(2, "can", shapes.can(), x=0.5, y=-0.3)], {}, BOX, arm, CONFIG
    ).placements
    assert side * (goal.position[0] - BOX.center[0]) > 0.02


def test_what_lies_in_the_box_takes_the_place_of_others_until_it_is_turned(shapes, arm):
    lying = shapes.estimate(1, "can", shapes.can())
    T = pose_from_yaw(0.0, np.array([*BOX.center, 0.04]))
    T[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    lying = replace(lying, T_world_object=T, resting="lying")
    other = shapes.estimate(2, "can", shapes.can(), x=0.5, y=-0.3)
    plan = plan_further([lying, other], {}, BOX, arm, CONFIG)
    goals = {p.name: np.array(p.position[:2]) for p in plan.placements}
    beside = np.maximum(np.abs(goals["can_2"] - BOX.center) - (0.06, 0.033), 0)
    assert np.linalg.norm(beside) > 0.033, "clear of the body that lies in the middle"
    assert set(goals) == {"can_1", "can_2"}


def test_a_mug_is_aligned_with_the_mugs_in_the_box(shapes, arm):
    placed = in_box(shapes.estimate(1, "mug", shapes.mug()), x=-0.08, yaw=0.7)
    plan = plan_further([shapes.estimate(2, "mug", shapes.mug(), x=0.5)], placed, BOX, arm, CONFIG)
    (goal,) = plan.placements
    assert goal.yaws == pytest.approx((0.7,))


def test_a_bowl_goes_into_the_uppermost_bowl_that_holds_it(shapes, arm):
    lower = in_box(shapes.estimate(1, "bowl", shapes.bowl(0.085, 0.06)), x=0.05)
    upper = to_standing(shapes.estimate(2, "bowl", shapes.bowl(0.07, 0.05)))
    lift = nest_heights([lower["bowl_1"], upper])[1]
    T = pose_from_yaw(0.0, np.array([BOX.center[0] + 0.055, BOX.center[1], BOX.floor + lift]))
    stack = lower | {"bowl_2": replace(upper, T_world_stand=T)}
    small = shapes.estimate(3, "bowl", shapes.bowl(0.055, 0.04), x=0.5)
    (goal,) = plan_further([small], stack, BOX, arm, CONFIG).placements
    assert goal.stack == ("bowl_1", "bowl_2")
    assert goal.position == pytest.approx((BOX.center[0] + 0.055, BOX.center[1], BOX.floor))
    assert goal.release_height > CONFIG.packing.release_height


def test_a_bowl_in_the_box_goes_into_a_larger_one_that_comes_later(shapes, arm):
    small = in_box(shapes.estimate(1, "bowl", shapes.bowl(0.06, 0.045)), x=-0.09)
    wide = shapes.estimate(3, "bowl", shapes.bowl(0.085, 0.06), x=0.5)
    beside, into = plan_further([wide], small, BOX, arm, CONFIG).placements
    assert beside.name == "bowl_3" and beside.stack == ()
    assert np.linalg.norm(np.subtract(beside.position, small["bowl_1"].T_world_stand[:3, 3])) > 0.06 + 0.085
    assert into.name == "bowl_1" and into.stack == ("bowl_3",) and into.position == beside.position
    can = in_box(shapes.estimate(2, "can", shapes.can(0.02, 0.06)), x=-0.09, z=BOX.floor + 0.008)
    (alone,) = plan_further([wide], small | can, BOX, arm, CONFIG).placements
    assert alone == beside, "what holds something stays"


def test_the_smallest_bowl_that_fits_into_another_stands_loose(shapes):
    def standing(number, radius, height, x):
        return in_box(shapes.estimate(number, "bowl", shapes.bowl(radius, height)), x=x)

    wide, middle = standing(1, 0.085, 0.06, 0.08), standing(2, 0.07, 0.05, -0.08)
    small = standing(3, 0.055, 0.04, 0.0)
    assert loose_bowl(wide | middle | small, BOX, CONFIG).name == "bowl_3"
    assert loose_bowl(wide | middle, BOX, CONFIG).name == "bowl_2"
    assert loose_bowl(wide, BOX, CONFIG) is None
    equal = standing(2, 0.085, 0.06, -0.09)
    inside = in_box(shapes.estimate(4, "can", shapes.can(0.02, 0.06)), x=-0.08)
    assert loose_bowl(wide | middle | inside, BOX, CONFIG) is None, "what holds something stays"
    tilted = {"bowl_2": replace(middle["bowl_2"], T_world_stand=np.diag([1.0, -1.0, -1.0, 1.0]))}
    assert loose_bowl(wide | tilted, BOX, CONFIG) is None
    assert loose_bowl(wide | equal, BOX, CONFIG) is not None, "equal bowls go into each other"


def test_a_full_box_has_no_room(shapes, arm):
    placed = in_box(shapes.estimate(1, "can", shapes.can(0.035, 0.1)))
    small = replace(BOX, size=(0.1, 0.1, 0.08))
    with pytest.raises(PlanningError, match="no room for can_2 is left in the box; use a larger box"):
        plan_further([shapes.estimate(2, "can", shapes.can(), x=0.5)], placed, small, arm, CONFIG)


def test_one_object_in_the_box_makes_room_for_what_found_none(shapes, arm):
    small = replace(BOX, size=(0.20, 0.10, 0.08))
    in_the_middle = in_box(shapes.estimate(1, "can", shapes.can(0.025, 0.1)))
    wide = shapes.estimate(2, "can", shapes.can(0.036, 0.1), x=0.5)
    plan = plan_further([wide], in_the_middle, small, arm, CONFIG)
    assert [goal.name for goal in plan.placements] == ["can_1", "can_2"], "what is in the way comes first"
    assert not plan.left_out
    first, second = (np.array(goal.position[:2]) - small.center for goal in plan.placements)
    assert np.linalg.norm(first - second) > 0.025 + 0.036 + 0.004
    for place, radius in ((first, 0.025), (second, 0.036)):
        assert (np.abs(place) + radius < np.array(small.size[:2]) / 2 - 0.004).all()


def test_nothing_is_moved_in_vain_and_bowls_never(shapes, arm):
    small = replace(BOX, size=(0.20, 0.10, 0.08))
    wide = shapes.estimate(2, "can", shapes.can(0.036, 0.1), x=0.5)
    placed = in_box(shapes.estimate(1, "can", shapes.can(0.025, 0.1)), x=-0.07)
    assert [goal.name for goal in plan_further([wide], placed, small, arm, CONFIG).placements] == ["can_2"]
    bowl = in_box(shapes.estimate(1, "bowl", shapes.bowl(0.045, 0.04)))
    with pytest.raises(PlanningError, match="no room for can_2"):
        plan_further([wide], bowl, replace(small, size=(0.18, 0.10, 0.08)), arm, CONFIG)
