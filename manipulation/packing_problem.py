"""Input of the layout search: settings, objects and their rasterised footprints."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from manipulation.footprints import Footprint, Stencil, footprint
from manipulation.grasp_config import GraspConfig
from manipulation.types import Box, GraspSet, StandingObject
from perception.types import ObjectEstimate


@dataclass(frozen=True)
class PackingConfig:
    """Settings of the layout search.

    Attributes:
        gaps: distances between objects in [m], tried in order.
        wall_gaps: distances from the walls in [m]; the larger ones are for objects that a wall keeps the hand
            from releasing.
        roomy_wall_gap: distance from the walls in [m] where the objects are at least as far apart.
        release_height: height above the floor at which an object is released, in [m].
        max_drop: largest height above its resting pose at which a nested bowl is released, in [m].
        nest_opening: largest distance in [m] by which the outer finger opens to release a nested bowl.
        nest_clearance: distance in [m] that this finger then keeps from the walls of lower bowls.
        enough_releases: number of collision-free releases of an object beyond which more do not count.
        n_handle_directions: number of handle directions.
        roomy_gap: least gap in [m] that all layouts are searched for before smaller ones are.
        row_width: largest distance of a mug from the line of all in relaxed layouts, in [m].
        n_relaxed: number of random layouts that are relaxed.
        n_restarts: how often others are relaxed where not all objects fit, and then without that line.
        least_gap: distance between objects in [m] that is tried at the very last.
        seed: seed of the random layouts.
    """

    gaps: tuple[float, ...] = (0.024, 0.020, 0.016, 0.012, 0.008, 0.005)
    wall_gaps: tuple[float, ...] = (0.008, 0.04, 0.075)
    roomy_wall_gap: float = 0.014
    release_height: float = 0.001
    max_drop: float = 0.056
    nest_opening: float = 0.0125
    nest_clearance: float = 0.003
    enough_releases: int = 4
    n_handle_directions: int = 8
    roomy_gap: float = 0.016
    row_width: float = 0.008
    n_relaxed: int = 192
    n_restarts: int = 3
    least_gap: float = 0.003
    seed: int = 0


class ShapeCache:
    """Cache of the objects' footprints and stencils by yaw and gap."""

    def __init__(self, items: Sequence[StandingObject], cell: float) -> None:
        self._footprints = {item.name: footprint(item) for item in items}
        self._widths = {item.name: float(np.ptp(item.vertices[:, :2], axis=0).max()) for item in items}
        self._cell = cell
        self._rotated: dict[tuple[str, float], Footprint] = {}
        self._stencils: dict[tuple[str, float, float], Stencil] = {}

    def width(self, name: str) -> float:
        """Return the larger horizontal extent in [m]."""
        return self._widths[name]

    def rotated(self, name: str, yaw: float) -> Footprint:
        key = (name, round(yaw, 4))
        if key not in self._rotated:
            self._rotated[key] = self._footprints[name].rotated(yaw)
        return self._rotated[key]

    def stencil(self, name: str, yaw: float, gap: float) -> Stencil:
        key = (name, round(yaw, 4), gap)
        if key not in self._stencils:
            self._stencils[key] = Stencil.of(self.rotated(name, yaw), gap, self._cell)
        return self._stencils[key]


def resting_on(objects: Sequence[ObjectEstimate]) -> dict[str, str]:
    """Return what each object rests on that rests on another one of the object map, all by name."""
    names = {estimate.id: estimate.name for estimate in objects}
    return {e.name: names[e.rests_on] for e in objects if e.rests_on in names}


def placed_later(resting: Mapping[str, str], below: Mapping[str, Collection[str]]) -> frozenset[str]:
    """Return the names of the objects that others rest on, and of the bowls that go into such ones.

    They come when the others have been taken away. A bowl that carries what goes into it in the box as well
    does not wait: neither of the two would come first.

    Args:
        resting: by the name of an object, that of the one that it rests on.
        below: by the name of each object with a goal, those of the bowls that it goes into.
    """
    covered = {
        lower
        for upper, lower in resting.items()
        if upper in below and lower in below and lower not in below[upper]
    }
    return frozenset(name for name, stack in below.items() if name in covered or covered.intersection(stack))


@dataclass(frozen=True)
class PackingProblem:
    """Input of the layout search: objects by name, stacks of bowls, grasps, box, settings.

    ``later`` are the names of the objects that come after all others.
    """

    items: Mapping[str, StandingObject]
    stacks: Sequence[Sequence[StandingObject]]
    grasps: Mapping[str, GraspSet]
    box: Box
    config: PackingConfig
    grasp_config: GraspConfig
    shapes: ShapeCache
    cell: float
    later: frozenset[str] = frozenset()

    @property
    def narrowest(self) -> float:
        """Largest distance in [m] from the walls that leaves room for the centre of an object."""
        return min(self.box.size[:2]) / 2 - 2 * self.cell

    @cached_property
    def nested(self) -> frozenset[str]:
        """Names of the bowls that stand in another."""
        return frozenset(bowl.name for stack in self.stacks for bowl in stack[1:])

    @property
    def order(self) -> list[str]:
        """Order of execution: bowls from the largest up, then the others by height to keep the hand above.

        Those that others rest on come last.
        """
        bowls = [bowl.name for stack in self.stacks for bowl in stack]
        others = sorted((i for i in self.items.values() if i.category != "bowl"), key=lambda i: i.top)
        return sorted(bowls + [item.name for item in others], key=self.later.__contains__)
