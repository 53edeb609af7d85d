"""Goals on a line, ascending in size, with gaps for the fingers."""

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
    """Spacing of objects on the line.

    Attributes:
        min_gap, max_gap: smallest and largest distance between neighbouring objects in [m].
        margin: free length at both ends of the line in [m].
        release_height: height above the table at which an object is released, in [m].
    """

    min_gap: float = 0.03
    max_gap: float = 0.09
    margin: float = 0.0
    release_height: float = 0.003


def sort_line(
    items: Sequence[StandingObject], line: Line, config: SortingConfig = SortingConfig()
) -> tuple[tuple[Placement, ...], dict[str, str]]:
    """Return the placements in the order of execution (low objects first), and the objects that do not fit.

    The widest objects are excluded until the others fit.

    Returns:
        Placements, and the reason by name for each excluded object.

    Raises:
        PlanningError: there are no objects, or none of them fits.
    """
    if not items:
        raise PlanningError("no object to sort was perceived")
    ascending = sorted(items, key=lambda item: item.size)
    along = np.arctan2(line.direction[1], line.direction[0])
    kept, left_out = list(ascending), []
    while _total_width(kept, along) + (len(kept) - 1) * config.min_gap > line.length - 2 * config.margin:
        widest = max(kept, key=lambda item: sum(_extents(item, along)))
        kept.remove(widest)
        left_out.append(widest.name)
        if not kept:
            raise PlanningError(f"line too short: none of {len(items)} objects fits on {line.length:.2f} m")
    room = line.length - 2 * config.margin - _total_width(kept, along)
    gap = min(room / max(len(kept) - 1, 1), config.max_gap)
    placements, progress = {}, config.margin
    for item in kept:
        before, after = _extents(item, along)
        placements[item.name] = goal_on_line(item, line, progress + before, config)
        progress += before + after + gap
    order = sorted(kept, key=lambda item: item.top)
    reason = f"line too short: {len(kept)} of {len(items)} fit on {line.length:.2f} m; use fewer objects"
    return tuple(placements[item.name] for item in order), {name: reason for name in left_out}


def goal_on_line(item: StandingObject, line: Line, position: float, config: SortingConfig) -> Placement:
    """Return the goal of an object at a position along a line, in metres from its start."""
    x, y = np.array(line.start) + position * line.direction
    along = float(np.arctan2(line.direction[1], line.direction[0]))
    return Placement(
        name=item.name,
        position=(float(x), float(y), 0.0),
        yaws=line_yaws(item, along),
        release_height=config.release_height,
    )


def line_yaws(item: StandingObject, along: float) -> tuple[float, ...]:
    """Return the admissible yaws on a line of azimuth ``along`` [rad]; handles point away from the line."""
    if item.category == "mug":
        return (float(along - np.pi / 2), float(along + np.pi / 2))
    return admissible_yaws(item, float(along))


def _extents(item: StandingObject, along: float) -> tuple[float, float]:
    """Return the extents [m] behind and ahead of the stand frame along the line, at the widest yaw."""
    direction = np.array([np.cos(along), np.sin(along)])
    shape = footprint(item)
    yaws = line_yaws(item, along)[:2]
    back = max(shape.rotated(yaw).reach(-direction) for yaw in yaws)
    forth = max(shape.rotated(yaw).reach(direction) for yaw in yaws)
    return back, forth


def _total_width(items: Sequence[StandingObject], along: float) -> float:
    """Return the sum of the objects' widths along the line in [m], without gaps."""
    return sum(sum(_extents(item, along)) for item in items)
