"""Where objects stand when sorted: on one line, ascending in size, with room for the fingers between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manipulation.errors import PlanningError
from manipulation.footprints import footprint
from manipulation.packing import admissible_yaws
from manipulation.types import Line, Placement, StandingObject


@dataclass(frozen=True)
class SortingConfig:
    """Spacing on the line.

    Attributes:
        min_gap, max_gap: between neighbouring objects in [m].
        margin: kept free at both ends of the line in [m].
        release_height: above the table, where an object is let go, in [m].
    """

    min_gap: float = 0.03
    max_gap: float = 0.09
    margin: float = 0.0
    release_height: float = 0.003


def sort_line(
    items: Sequence[StandingObject], line: Line, config: SortingConfig | None = None
) -> tuple[tuple[Placement, ...], dict[str, str]]:
    """Placements in the order of execution (low objects first), and what the line has no room for.

    Raises:
        PlanningError: there is nothing to sort.
    """
    config = config or SortingConfig()
    if not items:
        raise PlanningError("there is nothing to sort: no object was perceived")
    ascending = sorted(items, key=lambda item: item.size)
    along = np.arctan2(line.direction[1], line.direction[0])
    kept, left_out = list(ascending), []
    while _needed(kept, along) + (len(kept) - 1) * config.min_gap > line.length - 2 * config.margin:
        widest = max(kept, key=lambda item: sum(_extents(item, along)))
        kept.remove(widest)
        left_out.append(widest.name)
        if not kept:
            raise PlanningError(f"line too short: none of {len(items)} objects fits on {line.length:.2f} m")
    room = line.length - 2 * config.margin - _needed(kept, along)
    gap = min(room / max(len(kept) - 1, 1), config.max_gap)
    placements, progress = {}, config.margin
    for item in kept:
        before, after = _extents(item, along)
        x, y = np.array(line.start) + line.direction * (progress + before)
        placements[item.name] = Placement(
            name=item.name,
            position=(float(x), float(y), 0.0),
            yaws=line_yaws(item, along),
            release_height=config.release_height,
        )
        progress += before + after + gap
    order = sorted(kept, key=lambda item: item.top)
    reason = f"line too short: {len(kept)} of {len(items)} fit on {line.length:.2f} m; use fewer objects"
    return tuple(placements[item.name] for item in order), {name: reason for name in left_out}


def line_yaws(item: StandingObject, along: float) -> tuple[float, ...]:
    """Yaws on a line of direction ``along`` [rad]: handles stick out to one of its sides."""
    if item.category == "mug":
        return (float(along - np.pi / 2), float(along + np.pi / 2))
    return admissible_yaws(item, float(along))


def _extents(item: StandingObject, along: float) -> tuple[float, float]:
    """How far the object reaches back and forth along the line, in its widest admissible yaw, in [m]."""
    direction = np.array([np.cos(along), np.sin(along)])
    shape = footprint(item)
    yaws = line_yaws(item, along)[:2]
    back = max(shape.turned(yaw).reach(-direction) for yaw in yaws)
    forth = max(shape.turned(yaw).reach(direction) for yaw in yaws)
    return back, forth


def _needed(items: Sequence[StandingObject], along: float) -> float:
    return sum(sum(_extents(item, along)) for item in items)
