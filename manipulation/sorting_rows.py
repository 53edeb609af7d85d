"""Goals on parallel rows where one line is too short; sizes ascend along each row and from row to row."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Bool, Float

from manipulation.errors import PlanningError
from manipulation.footprints import footprint
from manipulation.sorting import SortingConfig, goal_on_line, line_yaws, sort_line
from manipulation.types import Line, Placement, StandingObject

OFFSETS = ((0.17, 0.19, 0.14), (-0.16, -0.18, -0.13))  # [m] tried, of rows on the base's side and beyond
REACH = (0.27, 0.73)  # [m] from the base, of the goals of further rows
AREA = ((-0.12, 0.70), (0.14, 0.50))  # [m], x and y of the goals of further rows
ROW_GAPS = (0.05, 0.04)  # [m] between neighbours, tried before the smallest gap
_STEP = 0.01  # [m] along a row


@dataclass(frozen=True)
class Rows:
    """Goals on one or more rows.

    Attributes:
        placements: goals in the order of execution: the row that is farthest from the base first, so that the
            arm never reaches over objects that stand, and low objects first within a row.
        left_out: name and reason of each object that does not fit.
        lines: rows in the order of sizes.
    """

    placements: tuple[Placement, ...]
    left_out: dict[str, str]
    lines: tuple[Line, ...]


def sort_rows(items: Sequence[StandingObject], line: Line, config: SortingConfig = SortingConfig()) -> Rows:
    """Return goals on the line, and on rows parallel to it if the line is too short.

    Objects that fit on no row are excluded, the widest ones first.

    Raises:
        PlanningError: there are no objects, or none of them fits on the line.
    """
    placements, left_out = sort_line(items, line, config)
    if not left_out:
        return Rows(placements, left_out, (line,))
    spans = {item.name: spans_along(item, line) for item in items}
    arrangements = list(_arrangements(line))
    kept, excluded = sorted(items, key=lambda item: item.size), []
    while kept:
        for gap, lines in product((*ROW_GAPS, config.min_gap), arrangements):
            rows = _fill(kept, lines, line, gap, spans)
            if sum(len(row) for row in rows) == len(kept):
                return _rows(rows, lines, excluded, config)
        widest = max(kept, key=lambda item: sum(spans[item.name][:2]))
        kept.remove(widest)
        excluded.append(widest.name)
    raise PlanningError(f"line too short: none of {len(items)} objects fits on {line.length:.2f} m")


def _arrangements(line: Line) -> Iterator[tuple[Line, ...]]:
    """Yield the rows in the order in which they are filled: the line first, then other orders and offsets.

    What fits depends on both, because wide objects are at the end of the order and rows differ in length.
    """
    for offsets in product(*OFFSETS):
        further = further_lines(line, offsets)
        yield from permutations((line, *further))


def further_lines(line: Line, offsets: Sequence[float]) -> tuple[Line, ...]:
    """Return rows parallel to a line within the arm's reach, at offsets towards the base [m]."""
    normal = normal_of(line)
    steps = np.arange(-0.5, line.length + 0.5, _STEP)
    rows = []
    for offset in offsets:
        points = np.array(line.start) + offset * normal + steps[:, None] * line.direction
        radius = np.linalg.norm(points, axis=1)
        inside = (radius >= REACH[0]) & (radius <= REACH[1])
        for axis, (low, high) in enumerate(AREA):
            inside &= (points[:, axis] >= low) & (points[:, axis] <= high)
        if inside.sum() > 1:
            first, last = points[inside][0], points[inside][-1]
            rows.append(Line((float(first[0]), float(first[1])), (float(last[0]), float(last[1]))))
    return tuple(rows)


# Extents [m] of an object on a row from its stand frame: behind, ahead, away from the base, towards it.
Spans = tuple[float, float, float, float]
# Extents [m] of an object in the axes of the first row: left, right along it; low, high across, to the base.
Extents = tuple[float, float, float, float]


def _fill(
    ascending: Sequence[StandingObject],
    lines: Sequence[Line],
    first: Line,
    gap: float,
    spans: Mapping[str, Spans],
) -> list[list[tuple[StandingObject, float]]]:
    """Return for each row its objects with their positions along it [m]; the last ones may be missing."""
    remaining = list(ascending)
    taken: list[Extents] = []
    rows: list[list[tuple[StandingObject, float]]] = []
    for line in lines:
        row: list[tuple[StandingObject, float]] = []
        progress = -np.inf
        while remaining:
            own = behind, ahead, *_ = spans[remaining[0].name]
            # The whole object stays within the line, but only the frame within the reach of further rows.
            least, most = (behind, line.length - ahead) if line is first else (0.0, line.length)
            positions = np.arange(max(progress + behind, least), most + 1e-9, _STEP / 2)
            free = are_free(positions, line, own, taken, first, gap)
            if not free.any():
                break
            position = float(positions[free.argmax()])
            row.append((remaining.pop(0), position))
            taken.append(extents_of(position, line, own, first))
            progress = position + ahead + gap
        rows.append(row)
    return rows


def extents_of(position: float, line: Line, spans: Spans, first: Line) -> Extents:
    """Return the extents of an object at a position [m] along a row in the axes of the first one."""
    (along, across), (behind, ahead, away, toward) = offset_of(line, first), spans
    at = along + position
    return at - behind, at + ahead, across - away, across + toward


def are_free(
    positions: Float[np.ndarray, "n"],
    line: Line,
    spans: Spans,
    taken: Sequence[Extents],
    first: Line,
    gap: float,
) -> Bool[np.ndarray, "n"]:
    """Return at which positions along a row an object is clear of others by a gap.

    Args:
        positions: positions in [m].
        line: the row.
        spans: extents of the object.
        taken: extents of the others in the axes of the first row.
        first: the first row.
        gap: distance kept in [m].
    """
    _, _, low, high = extents_of(0.0, line, spans, first)
    at, free = offset_of(line, first)[0] + positions, np.ones(len(positions), bool)
    for left, right, below, above in taken:
        if low < above + gap and below < high + gap:
            free &= (at - spans[0] >= right + gap) | (at + spans[1] <= left - gap)
    return free


def offset_of(line: Line, first: Line) -> tuple[float, float]:
    """Return where a row starts along the first one and across it, towards the base, in [m]."""
    offset = np.array(line.start) - np.array(first.start)
    return float(offset @ first.direction), float(offset @ normal_of(first))


def spans_along(item: StandingObject, line: Line) -> Spans:
    """Return the extents [m] of an object on rows parallel to a line, at the widest of its yaws there."""
    u, n = line.direction, normal_of(line)
    shape = footprint(item)
    turned = [shape.rotated(yaw) for yaw in line_yaws(item, float(np.arctan2(u[1], u[0])))[:2]]
    behind, ahead, away, toward = (max(s.reach(d) for s in turned) for d in (-u, u, -n, n))
    return behind, ahead, away, toward


def normal_of(line: Line) -> Float[np.ndarray, "2"]:
    """Return the unit normal of a line towards the robot's base."""
    normal = np.array([-line.direction[1], line.direction[0]])
    return -normal if normal @ np.array(line.start) > 0 else normal


def _rows(
    rows: Sequence[Sequence[tuple[StandingObject, float]]],
    lines: Sequence[Line],
    excluded: Sequence[str],
    config: SortingConfig,
) -> Rows:
    """Return the goals of filled rows."""
    used = [(line, row) for line, row in zip(lines, rows, strict=True) if row]
    placements = [
        goal_on_line(item, line, position, config)
        for line, row in sorted(used, key=lambda pair: -_distance(pair[0]))
        for item, position in sorted(row, key=lambda pair: pair[0].top)
    ]
    n_kept = len(placements)
    reason = (
        f"lines too short: {n_kept} of {n_kept + len(excluded)} fit on {len(lines)} rows; use fewer objects"
    )
    return Rows(tuple(placements), dict.fromkeys(excluded, reason), tuple(line for line, _ in used))


def _distance(line: Line) -> float:
    """Return the distance of a line from the base in [m]."""
    return float(np.array(line.start) @ -normal_of(line))
