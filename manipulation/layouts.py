"""Partial layouts of objects in a box: places, collision-free releases, and the rank among other layouts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from manipulation.footprints import BoxRaster, bounding_area
from manipulation.packing_problem import PackingProblem
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.types import StandingObject

Cost = Float[np.ndarray, "nx ny"]


@dataclass
class Layout:
    """A partial layout.

    Attributes:
        problem: objects and box.
        raster: occupied cells.
        positions, yaws: position relative to the box's centre in [m] and yaw in [rad] by name.
        left_out: names of the objects that do not fit.
        blocked: names of the objects without a collision-free release.
        freedom: number of collision-free releases, limited for each object.
    """

    problem: PackingProblem
    raster: BoxRaster
    positions: dict[str, Float[np.ndarray, "2"]] = field(default_factory=dict)
    yaws: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    blocked: list[str] = field(default_factory=list)
    freedom: int = 0

    def place(self, name: str, yaws: Iterable[float], cost: Cost, gap: float) -> None:
        """Place an object at the free cell of least cost, or leave it out.

        Args:
            name: object.
            yaws: yaws in [rad]; the first with a free cell of finite cost is taken.
            cost: costs of the cells.
            gap: least distance from occupied cells in [m].
        """
        for yaw in yaws:
            stencil = self.problem.shapes.stencil(name, yaw, gap)
            free = self.raster.free_positions(stencil) & np.isfinite(cost)
            if free.any():
                i, j = np.unravel_index(np.argmin(np.where(free, cost, np.inf)), free.shape)
                self.put(name, np.array([self.raster.x[i], self.raster.y[j]]), yaw)
                return
        self.left_out.append(name)

    def put(self, name: str, position: Float[np.ndarray, "2"], yaw: float) -> None:
        """Put an object at a position [m] and a yaw [rad], whether or not there is room."""
        self.raster.add(self.problem.shapes.stencil(name, yaw, 0.0), self.raster.cell_of(position))
        self.positions[name], self.yaws[name] = position, yaw

    def nest(self, stack: Sequence[StandingObject]) -> None:
        """Place the upper bowls of a stack where the lowest is, or leave them out with it."""
        lowest = stack[0].name
        for bowl in stack[1:]:
            if lowest in self.positions:
                self.positions[bowl.name], self.yaws[bowl.name] = self.positions[lowest], self.yaws[lowest]
            else:
                self.left_out.append(bowl.name)

    def count_releases(self) -> None:
        """Count the collision-free releases of each placed object in the order of execution."""
        problem = self.problem
        raster = BoxRaster(problem.box, 0.0, problem.cell)
        base = problem.box.floor + problem.config.release_height
        self.blocked, self.freedom = [], 0
        for name in (n for n in problem.order if n in self.positions):
            if name not in problem.nested:  # a nested bowl is released above all rims
                pose = ReleasePose(self.positions[name], self.yaws[name], base)
                grasps = problem.grasps[name].grasps
                count = count_free_releases(raster, grasps, pose, problem.grasp_config.gripper)
                self.blocked += [name] if count == 0 else []
                self.freedom += min(count, problem.config.enough_releases)
            stencil = problem.shapes.stencil(name, self.yaws[name], 0.0)
            raster.add(stencil, raster.cell_of(self.positions[name]), problem.box.floor)

    @property
    def missing(self) -> int:
        """Number of objects that are left out or have no collision-free release."""
        return len(self.left_out) + len(self.blocked)

    def rank(self) -> tuple[float, ...]:
        """Return the sort key, lower is better: objects not in place, those left out, releases, area."""
        shapes = [self.problem.shapes.rotated(name, self.yaws[name]) for name in self.positions]
        area = bounding_area(shapes, list(self.positions.values()))
        return (self.missing, len(self.left_out), -self.freedom, area)


def unreleasable(problem: PackingProblem) -> frozenset[str]:
    """Return the names of the objects without a collision-free release in the middle of the empty box."""
    raster = BoxRaster(problem.box, 0.0, problem.cell)
    base = problem.box.floor + problem.config.release_height
    yaws = 2 * np.pi * np.arange(problem.config.n_handle_directions) / problem.config.n_handle_directions
    return frozenset(
        name
        for name in problem.items
        if name not in problem.nested
        and not any(
            count_free_releases(
                raster,
                problem.grasps[name].grasps,
                ReleasePose(np.zeros(2), float(yaw), base),
                problem.grasp_config.gripper,
            )
            for yaw in yaws
        )
    )
