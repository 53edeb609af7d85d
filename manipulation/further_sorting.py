"""Plan for what is sorted after the others: between those that stand on the rows, few of which make room.

What the first scan could not see stands free once what hid it is sorted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig, find_usable
from manipulation.robot import ArmDescription
from manipulation.sorting import SortingConfig, goal_on_line
from manipulation.sorting_rows import (
    OFFSETS,
    Spans,
    are_free,
    extents_of,
    further_lines,
    offset_of,
    spans_along,
)
from manipulation.types import Box, Line, Placement, StandingObject, TaskPlan
from perception.types import ObjectEstimate

MOST_MOVED = 2  # objects on rows that are moved for others: each may be lost
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
        line: target line, beside which another row may be.
        arm: description of the arm.
        config: settings.
        box: box that is an obstacle; None if there is none.
        kinematics: kinematics of the arm; built if None.

    Raises:
        PlanningError: no object can be sorted; the message gives the reasons.
    """
    config = config.for_arm(arm)
    usable = find_usable(objects, kinematics or Kinematics(arm, config.pick_place.ik), config)
    found = _best_of_rows(usable.candidates, placed, lines, line, config.sorting)
    return TaskPlan(
        "sort",
        usable.items | dict(placed),
        tuple(found.placements),
        usable.left_out | dict(found.no_room),
        box,
        tuple(found.lines),
        usable.grasps,
    )


def out_of_order(placed: Mapping[str, StandingObject], lines: Sequence[Line]) -> set[str]:
    """Return the names of as few objects on the rows as leave the others in the order of size.

    Args:
        placed: objects on the rows where they are, by name.
        lines: the rows in the order of sizes.
    """
    names = sorted(placed, key=lambda name: _place(placed[name], lines))
    kept: list[tuple[str, ...]] = []  # the longest ascending sequence that ends at each object
    for name in names:
        before = [one for one in kept if placed[one[-1]].size < placed[name].size + SAME_SIZE]
        kept.append((*max(before, key=len, default=()), name))
    return set(names) - set(max(kept, key=len, default=()))


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


@dataclass(frozen=True)
class _Arrangement:
    """Goals on rows, in the order of execution, and why objects have none, by name."""

    placements: Sequence[Placement]
    no_room: Mapping[str, str]
    lines: Sequence[Line]


def _best_of_rows(
    items: Sequence[StandingObject],
    placed: Mapping[str, StandingObject],
    lines: Sequence[Line],
    line: Line,
    config: SortingConfig,
) -> _Arrangement:
    """Return the goals that leave the fewest objects out and, among these, move the fewest on the rows.

    On the rows there are, or on one more, before or after them.
    """
    best: _Arrangement | None = None
    rows = [lines, *_with_another(lines, line)]
    spans = {item.name: spans_along(item, line) for item in (*items, *placed.values())}
    for count in range(min(MOST_MOVED, len(placed)) + 1):
        for some, names, is_tight in product(rows, combinations(placed, count), (False, True)):
            moved = [placed[name] for name in names]
            there = {name: item for name, item in placed.items() if name not in names}
            made = _between(items, moved, there, some, spans, config, is_tight)
            if made.no_room.keys() & set(names):
                continue
            if best is None or len(made.no_room) < len(best.no_room):
                best = made
            if not best.no_room:
                return best
    assert best is not None  # what moves nothing
    return best


def _with_another(lines: Sequence[Line], line: Line) -> Iterator[Sequence[Line]]:
    """Yield the rows with one more, the last or the first, on a side of the target line that has none."""
    taken = {float(np.sign(across)) for row in lines if abs(across := offset_of(row, line)[1]) > _STEP}
    for offsets in OFFSETS:
        if float(np.sign(offsets[0])) in taken:
            continue
        for offset in offsets:
            for further in further_lines(line, (offset,)):
                yield (*lines, further)
                yield (further, *lines)


def _between(
    items: Sequence[StandingObject],
    moved: Sequence[StandingObject],
    there: Mapping[str, StandingObject],
    lines: Sequence[Line],
    spans: Mapping[str, Spans],
    config: SortingConfig,
    is_tight: bool,
) -> _Arrangement:
    """Return goals between the objects on the rows.

    Args:
        items: objects beside the rows.
        moved: objects that leave their places on the rows: first, for they make room.
        there: objects that stay, by name.
        lines: the rows in the order of sizes.
        spans: extents of all objects along the rows, which are parallel, by name.
        config: settings.
        is_tight: whether each is next to the smaller one rather than in the middle of the free places.
    """
    on_rows = [_OnRow(item.size, *_place(item, lines), spans[name]) for name, item in there.items()]
    placements: dict[str, Placement] = {}
    for item in sorted((*items, *moved), key=lambda item: item.size):
        found = _free_position(item, spans[item.name], on_rows, lines, config.min_gap, is_tight)
        if found is None:
            continue
        on_rows.append(found)
        placements[item.name] = goal_on_line(item, lines[found.row], found.position, config)
    order = [*sorted(moved, key=lambda item: item.top), *sorted(items, key=lambda item: item.top)]
    reasons = {
        item.name: f"no room for {item.name} between those of its size on {len(lines)} rows"
        for item in order
        if item.name not in placements
    }
    return _Arrangement([placements[item.name] for item in order if item.name in placements], reasons, lines)


def _place(item: StandingObject, lines: Sequence[Line]) -> tuple[int, float]:
    """Return the number of the row that is nearest to an object, and its position along it in [m]."""
    at = [line.position(item.T_world_stand[:2, 3]) for line in lines]
    row = min(range(len(lines)), key=lambda k: at[k][1])
    return row, at[row][0]


def _free_position(
    item: StandingObject,
    spans: Spans,
    there: Sequence[_OnRow],
    lines: Sequence[Line],
    gap: float,
    is_tight: bool,
) -> _OnRow | None:
    """Return the first or the middle position between the neighbours in size; None if all are taken."""
    before = max((o for o in there if o.size <= item.size), key=lambda o: (o.row, o.position), default=None)
    after = min((o for o in there if o.size > item.size), key=lambda o: (o.row, o.position), default=None)
    first = 0 if before is None else before.row
    last = len(lines) - 1 if after is None else after.row
    taken = [extents_of(o.position, lines[o.row], o.spans, lines[0]) for o in there]
    for row in range(first, last + 1):
        line = lines[row]
        low, high = spans[0], line.length - spans[1]
        if before is not None and before.row == row:
            low = max(low, before.right + gap + spans[0])
        if after is not None and after.row == row:
            high = min(high, after.left - gap - spans[1])
        positions = np.arange(low, high + 1e-9, _STEP)
        free = positions[are_free(positions, line, spans, taken, lines[0], gap)]
        if len(free):
            middle = (free[0] + free[-1]) / 2
            best = free[0] if is_tight else min(free, key=lambda x: abs(x - middle))
            return _OnRow(item.size, row, float(best), spans)
    return None
