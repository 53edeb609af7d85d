"""What is sorted later: between its neighbours in size where there is room, else few make room."""

from dataclasses import replace

import numpy as np
import pytest

from manipulation.further_sorting import MOST_MOVED, SAME_SIZE, STAYS, out_of_order, plan_further_sort
from manipulation.packing import admissible_yaws
from manipulation.sorting import sort_line
from manipulation.standing import to_standing
from manipulation.types import Line
from perception.geometry import pose_from_yaw

LINE = Line((0.66, 0.16), (-0.10, 0.56))
HEIGHTS = (0.06, 0.08, 0.10, 0.12, 0.14)


@pytest.fixture(scope="module")
def cans(shapes):
    return [
        shapes.estimate(i, "can", shapes.can(0.03, height), x=0.5, y=-0.3 + 0.1 * i)
        for i, height in enumerate(HEIGHTS)
    ]


def on_rows(estimates, line=LINE):
    """The objects as they stand once all of them are sorted, by name."""
    items = {estimate.name: to_standing(estimate) for estimate in estimates}
    placements, left_out = sort_line(list(items.values()), line)
    assert not left_out
    return {
        goal.name: replace(
            items[goal.name], T_world_stand=pose_from_yaw(goal.yaws[0], np.array(goal.position))
        )
        for goal in placements
    }


def along(plan, placed, line=LINE):
    """Positions of all objects on the line once the plan is carried out, by size."""
    goals = {goal.name: np.array(goal.position[:2]) for goal in plan.placements}
    sizes = {name: item.size for name, item in plan.objects.items()}
    places = {name: goals.get(name, item.T_world_stand[:2, 3]) for name, item in plan.objects.items()}
    return [line.position(places[name])[0] for name in sorted(sizes, key=sizes.__getitem__)]


@pytest.mark.parametrize("late", range(5))
def test_what_comes_later_stands_between_its_neighbours_in_size(cans, arm, late):
    """In the place that was left for it the others stay where they are."""
    placed = {name: item for name, item in on_rows(cans).items() if name != cans[late].name}
    plan = plan_further_sort([cans[late]], placed, (LINE,), LINE, arm)
    assert plan.task == "sort" and [goal.name for goal in plan.placements] == [cans[late].name]
    assert plan.lines == (LINE,) and not plan.left_out and plan.objects.keys() == {c.name for c in cans}
    positions = along(plan, placed)
    assert (np.diff(positions) >= 0.06 + 0.03 - 1e-9).all(), "2 radii and the smallest gap apart, in order"
    goal = plan.placements[0]
    assert goal.yaws and set(goal.yaws) <= set(admissible_yaws(plan.objects[goal.name], goal.yaws[0]))


@pytest.mark.parametrize(("others", "is_sorted_anew"), [((1, 3), True), ((0, 1, 3, 4), False)])
def test_without_room_between_few_objects_make_room(cans, arm, others, is_sorted_anew):
    """Of those that stand there, the ones that are at their new places are not moved."""
    items = sorted(on_rows([cans[k] for k in others]).values(), key=lambda item: item.size)
    tight = {
        item.name: replace(item, T_world_stand=pose_from_yaw(0.0, np.array([*_point(0.05 + 0.09 * k), 0.0])))
        for k, item in enumerate(items)
    }
    plan = plan_further_sort([cans[2]], tight, (LINE,), LINE, arm)
    if not is_sorted_anew:
        assert not plan.placements and plan.left_out.keys() == {cans[2].name}
        return
    moved = {goal.name for goal in plan.placements} & tight.keys()
    assert not plan.left_out and cans[2].name in {goal.name for goal in plan.placements}
    assert 0 < len(moved) <= MOST_MOVED
    assert (np.diff(along(plan, tight)) >= 0.06 + 0.03 - STAYS - 1e-9).all()
    for goal in plan.placements:
        if goal.name in moved:
            apart = np.array(goal.position[:2]) - tight[goal.name].T_world_stand[:2, 3]
            assert np.linalg.norm(apart) >= STAYS


def test_what_fits_nowhere_is_left_out_and_nothing_is_moved(cans, arm):
    short = Line((0.60, 0.2), (0.60, 0.46))
    placed = on_rows(cans[:2], short)
    many = [replace(can, id=10 + k) for k, can in enumerate(cans * 6)]
    plan = plan_further_sort(many, placed, (short,), short, arm)
    assert plan.left_out and all("no room" in reason for reason in plan.left_out.values())
    assert not {goal.name for goal in plan.placements} & placed.keys()


def _point(position):
    return np.array(LINE.start) + position * LINE.direction


def test_as_few_as_possible_are_out_of_order(cans):
    placed = on_rows(cans)
    assert out_of_order(placed, (LINE,)) == set() == out_of_order({}, (LINE,))
    for name, size in (("can_1", 0.2), ("can_3", 0.05)):
        wrong = placed | {name: replace(placed[name], size=size)}
        assert out_of_order(wrong, (LINE,)) == {name}
    first, last = placed["can_0"], placed["can_4"]
    swapped = placed | {"can_0": replace(first, size=last.size), "can_4": replace(last, size=first.size)}
    assert out_of_order(swapped, (LINE,)) == {"can_0", "can_4"}


def test_either_order_of_about_the_same_size_counts(cans):
    placed = on_rows(cans)
    for beyond, expected in ((0.9, set()), (1.1, {"can_1"})):
        size = placed["can_2"].size + beyond * SAME_SIZE
        three = {name: item for name, item in placed.items() if name in ("can_0", "can_1", "can_2")}
        found = out_of_order(three | {"can_1": replace(three["can_1"], size=size)}, (LINE,))
        assert len(found) == len(expected)


def test_rows_follow_each_other(cans):
    """The first row ends before the second begins."""
    first, second = Line((0.60, 0.2), (0.60, 0.46)), Line((0.45, 0.2), (0.45, 0.46))
    low, high = on_rows(cans[:2], first), on_rows(cans[2:4], second)
    assert out_of_order(low | high, (first, second)) == set()
    assert len(out_of_order(low | high, (second, first))) == 2
