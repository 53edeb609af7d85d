"""Goals on parallel rows where one line is too short; sizes ascend along each row and from row to row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from manipulation.errors import PlanningError
from manipulation.footprints import footprint
from manipulation.sorting import SortingConfig, line_yaws, sort_line
from manipulation.types import Line, Placement, StandingObject

OFFSETS = (0.17, -0.16)  # [m] of the further rows from the line, towards the base and away from it
REACH = (0.27, 0.73)  # [m] from the base, of the goals of further rows
AREA = ((-0.15, 0.70), (0.14, 0.50))  # [m], x and y of the goals of further rows
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
    lines = (line, *further_lines(line))
    kept, excluded = sorted(items, key=lambda item: item.size), []
    while kept:
        for gap in (*ROW_GAPS, config.min_gap):
            rows = _fill(kept, lines, gap)
            if sum(len(row) for row in rows) == len(kept):
                return _rows(rows, lines, excluded, config)
        widest = max(kept, key=lambda item: sum(_spans(item, lines[0])[:2]))
        kept.remove(widest)
        excluded.append(widest.name)
    raise PlanningError(f"line too short: none of {len(items)} objects fits on {line.length:.2f} m")


def further_lines(line: Line) -> tuple[Line, ...]:
    """Return rows parallel to a line within the arm's reach, in the order in which they are filled."""
    normal = _normal(line)
    steps = np.arange(-0.5, line.length + 0.5, _STEP)
    rows = []
    for offset in OFFSETS:
        points = np.array(line.start) + offset * normal + steps[:, None] * line.direction
        radius = np.linalg.norm(points, axis=1)
        inside = (radius >= REACH[0]) & (radius <= REACH[1])
        for axis, (low, high) in enumerate(AREA):
            inside &= (points[:, axis] >= low) & (points[:, axis] <= high)
        if inside.sum() > 1:
            first, last = points[inside][0], points[inside][-1]
            rows.append(Line((float(first[0]), float(first[1])), (float(last[0]), float(last[1]))))
    return tuple(rows)


def _fill(
    ascending: Sequence[StandingObject], lines: Sequence[Line], gap: float
) -> list[list[tuple[StandingObject, float]]]:
    """Return for each row its objects with their positions along it [m]; the last ones may be missing."""
    remaining = list(ascending)
    taken: list[tuple[float, float, float, float]] = []  # rectangles in the frame of the first line
    rows: list[list[tuple[StandingObject, float]]] = []
    for line in lines:
        row: list[tuple[StandingObject, float]] = []
        progress = 0.0
        while remaining:
            position = _free_position(remaining[0], line, lines[0], progress, gap, taken)
            if position is None:
                break
            item = remaining.pop(0)
            row.append((item, position))
            taken.append(_rectangle(item, line, lines[0], position))
            progress = position + _spans(item, line)[1] + gap
        rows.append(row)
    return rows


def _free_position(
    item: StandingObject,
    line: Line,
    first: Line,
    progress: float,
    gap: float,
    taken: Sequence[tuple[float, float, float, float]],
) -> float | None:
    """Return the first position along a row, from ``progress`` on, without overlap; None if there is none."""
    before, after = _spans(item, line)[:2]
    for position in np.arange(progress + before, line.length - after + 1e-9, _STEP / 2):
        rectangle = _rectangle(item, line, first, float(position))
        if all(_apart(rectangle, other, gap) for other in taken):
            return float(position)
    return None


def _apart(a: tuple[float, float, float, float], b: tuple[float, float, float, float], gap: float) -> bool:
    """Return whether two rectangles (left, right, low, high) are ``gap`` [m] apart along one of the axes."""
    return a[1] + gap <= b[0] or b[1] + gap <= a[0] or a[3] + gap <= b[2] or b[3] + gap <= a[2]


def _rectangle(
    item: StandingObject, line: Line, first: Line, position: float
) -> tuple[float, float, float, float]:
    """Return the object's extent along and across the first line: left, right, low, high [m]."""
    before, after, back, forth = _spans(item, line)
    offset = np.array(line.start) + position * line.direction - np.array(first.start)
    along, across = float(offset @ first.direction), float(offset @ _normal(first))
    return along - before, along + after, across - back, across + forth


def _spans(item: StandingObject, line: Line) -> tuple[float, float, float, float]:
    """Return the extents [m] of an object behind, ahead, away from the base and towards it on a row."""
    u, n = line.direction, _normal(line)
    shape = footprint(item)
    turned = [shape.rotated(yaw) for yaw in line_yaws(item, float(np.arctan2(u[1], u[0])))[:2]]
    behind, ahead, away, toward = (max(s.reach(d) for s in turned) for d in (-u, u, -n, n))
    return behind, ahead, away, toward


def _normal(line: Line) -> Float[np.ndarray, "2"]:
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
    placements: list[Placement] = []
    for line, row in sorted(used, key=lambda pair: -_distance(pair[0])):
        for item, position in sorted(row, key=lambda pair: pair[0].top):
            x, y = np.array(line.start) + position * line.direction
            along = float(np.arctan2(line.direction[1], line.direction[0]))
            placements.append(
                Placement(
                    name=item.name,
                    position=(float(x), float(y), 0.0),
                    yaws=line_yaws(item, along),
                    release_height=config.release_height,
                )
            )
    n_kept = len(placements)
    reason = (
        f"lines too short: {n_kept} of {n_kept + len(excluded)} fit on {len(lines)} rows; use fewer objects"
    )
    return Rows(tuple(placements), dict.fromkeys(excluded, reason), tuple(line for line, _ in used))


def _distance(line: Line) -> float:
    """Return the distance of a line from the base in [m]."""
    return float(np.array(line.start) @ -_normal(line))
