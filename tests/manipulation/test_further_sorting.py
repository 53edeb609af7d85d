"""What is sorted later: between its neighbours in size where there is room, else few make room."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from manipulation.further_sorting import MOST_MOVED, SAME_SIZE, out_of_order, plan_further_sort
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


def at_positions(items, positions, line=LINE):
    """Objects on a line at given positions [m], in the order of size, by name."""
    ascending = sorted(items.values(), key=lambda item: item.size)
    return {
        item.name: replace(
            item,
            T_world_stand=pose_from_yaw(0.0, np.array([*np.array(line.start) + x * line.direction, 0.0])),
        )
        for item, x in zip(ascending, positions, strict=True)
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


@pytest.mark.parametrize(
    ("apart", "n_moved"),
    [((0.0, 0.09, 0.27, 0.36), 0), ((0.0, 0.09, 0.18, 0.45), 1), ((0.0, 0.09, 0.18, 0.27), 2)],
)
def test_without_room_between_as_few_objects_as_possible_make_room(cans, arm, apart, n_moved):
    """They are moved first."""
    others = [can for can in cans if can is not cans[2]]
    tight = at_positions(on_rows(others), [0.05 + x for x in apart])
    plan = plan_further_sort([cans[2]], tight, (LINE,), LINE, arm)
    *moved, last = [goal.name for goal in plan.placements]
    assert last == cans[2].name and len(moved) == n_moved <= MOST_MOVED and not plan.left_out
    assert plan.lines == (LINE,) and set(moved) <= tight.keys()
    assert (np.diff(along(plan, tight)) >= 0.06 + 0.03 - 0.005 - 1e-9).all()


@pytest.mark.parametrize("late", range(5))
def test_where_the_rows_are_full_there_is_another_one_before_or_after_them(cans, arm, late):
    """The others stay in their row, but for two at most."""
    others = [can for k, can in enumerate(cans) if k != late]
    line = Line((0.60, 0.16), (0.60, 0.50))
    placed = at_positions(on_rows(others), [0.03, 0.12, 0.21, 0.30], line)
    plan = plan_further_sort([cans[late]], placed, (line,), line, arm)
    assert not plan.left_out and len(plan.lines) == 2 and line in plan.lines
    assert len({goal.name for goal in plan.placements} & placed.keys()) <= MOST_MOVED
    goals = {goal.name: goal.position for goal in plan.placements}
    places = {name: goals.get(name, item.T_world_stand[:3, 3]) for name, item in plan.objects.items()}
    there = {
        name: replace(item, T_world_stand=pose_from_yaw(0.0, np.array(places[name])))
        for name, item in plan.objects.items()
    }
    assert out_of_order(there, plan.lines) == set()
    away = [np.linalg.norm(there[a].T_world_stand[:2, 3] - there[b].T_world_stand[:2, 3])
            for a, b in combinations(there, 2)]  # fmt: skip
    assert min(away) >= 0.06 + 0.03 - 1e-9


def test_on_each_side_of_the_line_there_is_one_row_at_most(cans, arm):
    line, sides = Line((0.45, 0.2), (0.45, 0.46)), ((0.60, 0.2), (0.30, 0.2))
    beyond, near = (Line(start, (start[0], 0.46)) for start in sides)
    for lines, n_rows in (((line,), 2), ((line, beyond), 3), ((near, line, beyond), 3)):
        placed = {}
        for row in lines:
            some = [replace(can, id=can.id + 10 * len(placed)) for can in cans[1:4]]
            placed |= at_positions(on_rows(some), [0.03, 0.12, 0.21], row)
        plan = plan_further_sort([cans[0]], placed, lines, line, arm)
        assert len(plan.lines) == n_rows if not plan.left_out else len(plan.lines) == len(lines)


def test_what_fits_nowhere_is_left_out_and_nothing_is_moved(cans, arm):
    short = Line((0.60, 0.2), (0.60, 0.46))
    placed = on_rows(cans[:2], short)
    many = [replace(can, id=10 + k) for k, can in enumerate(cans * 3)]
    plan = plan_further_sort(many, placed, (short,), short, arm)
    assert plan.left_out and all("no room" in reason for reason in plan.left_out.values())
    assert not {goal.name for goal in plan.placements} & placed.keys()


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
