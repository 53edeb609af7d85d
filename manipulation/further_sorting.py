"""Plan for what is sorted after the others: between those that stand on the rows, few of which make room.

What the first scan could not see stands free once what hid it is sorted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig, find_usable
from manipulation.robot import ArmDescription
from manipulation.sorting import SortingConfig, goal_on_line
from manipulation.sorting_rows import Spans, normal_of, sort_rows, spans_along
from manipulation.types import Box, Line, Placement, StandingObject, TaskPlan
from perception.types import ObjectEstimate

MOST_MOVED = 2  # objects on rows that are moved for others: each may be lost
STAYS = 0.015  # [m] between an object on a row and its goal, up to which it is not moved
SAME_SIZE = 0.002  # [m] of difference, up to which either order counts
_STEP = 0.005  # [m] along a row


def plan_further_sort(
    objects: Sequence[ObjectEstimate],
    placed: Mapping[str, StandingObject],
    lines: Sequence[Line],
    line: Line,
    arm: ArmDescription,
    config: ManipulationConfig = ManipulationConfig(),
    box: Box | None = None,
    kinematics: Kinematics | None = None,
) -> TaskPlan:
    """Plan to sort objects into rows on which others stand, of which at most ``MOST_MOVED`` make room.

    Args:
        objects: object map of what is beside the rows.
        placed: objects on the rows where they are, by name.
        lines: the rows in the order of sizes, at least one.
        line: target line, for rows that have room for all.
        arm: description of the arm.
        config: settings.
        box: box that is an obstacle; None if there is none.
        kinematics: kinematics of the arm; built if None.

    Raises:
        PlanningError: no object can be sorted; the message gives the reasons.
    """
    config = config.for_arm(arm)
    usable = find_usable(objects, kinematics or Kinematics(arm, config.pick_place.ik), config)
    placements, no_room = _between(usable.candidates, placed, lines, config.sorting)
    if no_room:
        rows = sort_rows([*usable.candidates, *placed.values()], line, config.sorting)
        moving = [goal for goal in rows.placements if not _stays(goal, placed)]
        if not rows.left_out and len(placed.keys() & {goal.name for goal in moving}) <= MOST_MOVED:
            placements, lines, no_room = moving, rows.lines, {}
    return TaskPlan(
        "sort",
        usable.items | dict(placed),
        tuple(placements),
        usable.left_out | no_room,
        box,
        tuple(lines),
        usable.grasps,
    )


def out_of_order(placed: Mapping[str, StandingObject], lines: Sequence[Line]) -> set[str]:
    """Return the names of as few objects on the rows as leave the others in the order of size.

    Args:
        placed: objects on the rows where they are, by name.
        lines: the rows in the order of sizes.
    """
    there = {name: _where(item, lines) for name, item in placed.items()}
    names = sorted(there, key=lambda name: (there[name].row, there[name].position))
    kept: list[tuple[str, ...]] = []  # the longest ascending sequence that ends at each object
    for name in names:
        before = [one for one in kept if there[one[-1]].size < there[name].size + SAME_SIZE]
        kept.append((*max(before, key=len, default=()), name))
    return set(names) - set(max(kept, key=len, default=()))


def _stays(goal: Placement, placed: Mapping[str, StandingObject]) -> bool:
    """Return whether an object stands at its goal already."""
    if goal.name not in placed:
        return False
    apart = placed[goal.name].T_world_stand[:2, 3] - np.array(goal.position[:2])
    return float(np.linalg.norm(apart)) < STAYS


@dataclass(frozen=True)
class _OnRow:
    """An object on a row: size, number of the row, position along it and extents there, in [m]."""

    size: float
    row: int
    position: float
    spans: Spans

    @property
    def left(self) -> float:
        return self.position - self.spans[0]

    @property
    def right(self) -> float:
        return self.position + self.spans[1]


def _between(
    items: Sequence[StandingObject],
    placed: Mapping[str, StandingObject],
    lines: Sequence[Line],
    config: SortingConfig,
) -> tuple[list[Placement], dict[str, str]]:
    """Return goals between the objects on the rows, low objects first, and why others have none."""
    there = [_where(item, lines) for item in placed.values()]
    placements: dict[str, Placement] = {}
    for item in sorted(items, key=lambda item: item.size):
        found = _free_position(item, there, lines, config.min_gap)
        if found is None:
            continue
        there.append(found)
        placements[item.name] = goal_on_line(item, lines[found.row], found.position, config)
    order = sorted(items, key=lambda item: item.top)
    reasons = {
        item.name: f"no room for {item.name} between those of its size on {len(lines)} rows"
        for item in order
        if item.name not in placements
    }
    return [placements[item.name] for item in order if item.name in placements], reasons


def _where(item: StandingObject, lines: Sequence[Line]) -> _OnRow:
    """Return where an object is on the row that is nearest to it."""
    at = [line.position(item.T_world_stand[:2, 3]) for line in lines]
    row = min(range(len(lines)), key=lambda k: at[k][1])
    return _OnRow(item.size, row, at[row][0], spans_along(item, lines[row]))


def _free_position(
    item: StandingObject, there: Sequence[_OnRow], lines: Sequence[Line], gap: float
) -> _OnRow | None:
    """Return the position in the middle of the free ones between the neighbours in size; None without any."""
    before = max((o for o in there if o.size <= item.size), key=lambda o: (o.row, o.position), default=None)
    after = min((o for o in there if o.size > item.size), key=lambda o: (o.row, o.position), default=None)
    first = 0 if before is None else before.row
    last = len(lines) - 1 if after is None else after.row
    for row in range(first, last + 1):
        line, spans = lines[row], spans_along(item, lines[row])
        low, high = spans[0], line.length - spans[1]
        if before is not None and before.row == row:
            low = max(low, before.right + gap + spans[0])
        if after is not None and after.row == row:
            high = min(high, after.left - gap - spans[1])
        positions = np.arange(low, high + 1e-9, _STEP)
        free = [
            x for x in positions
            if not any(_meets(_OnRow(item.size, row, float(x), spans), o, lines, gap) for o in there)
        ]  # fmt: skip
        if free:
            middle = (free[0] + free[-1]) / 2
            best = min(free, key=lambda x: abs(x - middle))
            return _OnRow(item.size, row, float(best), spans)
    return None


def _meets(one: _OnRow, other: _OnRow, lines: Sequence[Line], gap: float) -> bool:
    """Return whether the bounding rectangles along the first row of two objects are closer than ``gap``."""

    def rectangle(o: _OnRow) -> tuple[np.ndarray, np.ndarray]:
        first, line = lines[0], lines[o.row]
        u, n = first.direction, normal_of(first)
        centre = np.array(line.start) + o.position * line.direction - np.array(first.start)
        behind, ahead, away, toward = o.spans
        x, y = float(centre @ u), float(centre @ n)
        return np.array([x - behind, y - away]), np.array([x + ahead, y + toward])

    (low, high), (others_low, others_high) = rectangle(one), rectangle(other)
    return bool((low < others_high + gap).all() and (others_low < high + gap).all())
