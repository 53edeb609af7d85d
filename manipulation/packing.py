"""Where objects go in a box: bowls nested, mugs in a line with handles alike, cans and bottles around them.

Objects are laid out greedily on a raster for many choices (line of the mugs, direction of their handles,
corner to fill from, gaps). Layouts are judged by how much fits, how freely the hand can let go of everything
in the order of execution, and how little room they take.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from manipulation.errors import PlanningError
from manipulation.footprints import BoxRaster, Footprint, Stencil, bounding_area, footprint
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.nesting import nest_heights, stack_bowls
from manipulation.release_clearance import count_releases
from manipulation.robot import GripperGeometry
from manipulation.types import Box, Grasp, Placement, StandingObject


@dataclass(frozen=True)
class PackingConfig:
    """How tightly to pack.

    Attributes:
        gaps: distances between objects to try, in [m], the widest that works is used.
        wall_gaps: distances from the walls in [m]; a larger one where the hand could not let go at a wall.
        release_height: above the floor, where an object is let go, in [m].
        max_drop: largest height above its resting place from which a nested bowl is let go, in [m].
        wanted_releases: ways for the hand to let go that make an object count as free.
        n_handle_directions: directions of the handles tried.
    """

    gaps: tuple[float, ...] = (0.024, 0.020, 0.016, 0.012, 0.008, 0.005)
    wall_gaps: tuple[float, ...] = (0.008, 0.04, 0.075)
    release_height: float = 0.003
    max_drop: float = 0.044
    wanted_releases: int = 4
    n_handle_directions: int = 8


class _Shapes:
    """Footprints and stencils of the items, computed once per yaw and gap."""

    def __init__(self, items: Sequence[StandingObject], cell: float) -> None:
        self._flat = {item.name: footprint(item) for item in items}
        self._cell = cell
        self._turned: dict[tuple[str, float], Footprint] = {}
        self._stencils: dict[tuple[str, float, float], Stencil] = {}

    def turned(self, name: str, yaw: float) -> Footprint:
        key = (name, round(yaw, 4))
        if key not in self._turned:
            self._turned[key] = self._flat[name].turned(yaw)
        return self._turned[key]

    def stencil(self, name: str, yaw: float, gap: float) -> Stencil:
        key = (name, round(yaw, 4), gap)
        if key not in self._stencils:
            self._stencils[key] = Stencil.of(self.turned(name, yaw), gap, self._cell)
        return self._stencils[key]


@dataclass(frozen=True)
class _Problem:
    """What is to be packed: objects by name, stacks of bowls, grasps, box, settings."""

    items: Mapping[str, StandingObject]
    stacks: Sequence[Sequence[StandingObject]]
    grasps: Mapping[str, Sequence[Grasp]]
    box: Box
    config: PackingConfig
    grasp_config: GraspConfig
    shapes: _Shapes
    cell: float

    @property
    def order(self) -> list[str]:
        """Bowls from the largest up, then low objects before tall ones: the hand stays above what stands."""
        bowls = [bowl.name for stack in self.stacks for bowl in stack]
        others = sorted((i for i in self.items.values() if i.category != "bowl"), key=lambda i: i.top)
        return bowls + [item.name for item in others]


@dataclass
class _Layout:
    """A layout in the making: positions relative to the box's centre, and yaws, by name."""

    raster: BoxRaster
    cells: dict[str, tuple[int, int]] = field(default_factory=dict)
    positions: dict[str, np.ndarray] = field(default_factory=dict)
    yaws: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    n_blocked: int = 0
    freedom: int = 0


@dataclass(frozen=True)
class _Choice:
    """One way to lay out: a line for the mugs (through a point, along a direction) and a filling order."""

    line_point: tuple[float, float]
    line_direction: tuple[float, float]
    handle_yaw: float
    corner: tuple[float, float]


def pack(
    items: Sequence[StandingObject],
    box: Box,
    config: PackingConfig | None = None,
    grasp_config: GraspConfig | None = None,
) -> tuple[tuple[Placement, ...], dict[str, str]]:
    """Placements in the order of execution, and name and reason of what does not fit.

    Raises:
        PlanningError: nothing fits.
    """
    config, grasp_config = config or PackingConfig(), grasp_config or GraspConfig()
    if not items:
        raise PlanningError("there is nothing to pack: no object was perceived")
    grasps = {item.name: grasp_candidates(item, grasp_config).grasps for item in items}
    stacks = stack_bowls([item for item in items if item.category == "bowl"])
    cell = BoxRaster(box, 0.0).cell
    narrowest = min(box.size[:2]) / 2 - 2 * cell
    problem = _Problem(
        {item.name: item for item in items},
        stacks, grasps, box, config, grasp_config, _Shapes(items, cell), cell,
    )  # fmt: skip
    best: _Layout | None = None
    for gap, wall_gap in itertools.product(config.gaps, config.wall_gaps):
        if wall_gap > config.wall_gaps[0] and (best is None or best.left_out or wall_gap > narrowest):
            continue  # more room at the walls helps only where all fits, but the hand is in the way
        # Objects keep ``gap`` from all that is taken; the walls stand back, for ``wall_gap`` is enough there.
        empty = BoxRaster(box, wall_gap - gap)
        for choice in _choices(problem, wall_gap):
            allowed = len(items) if best is None else len(best.left_out)
            layout = _lay_out(problem, choice, gap, empty, allowed)
            if best is None or _rank(layout, problem) < _rank(best, problem):
                best = layout
        if best is not None and not best.left_out and not best.n_blocked:
            break
    assert best is not None
    if not best.positions:
        raise PlanningError(
            f"box too small: 0 of {len(items)} fit into {box.size[0]:.2f} x {box.size[1]:.2f} m; "
            "use a larger box"
        )
    fitted = len(items) - len(best.left_out)
    reason = (
        f"box too small: {fitted} of {len(items)} fit into {box.size[0]:.2f} x {box.size[1]:.2f} m; "
        "use a larger box or fewer objects"
    )
    return _placements(problem, best), {name: reason for name in best.left_out}


def nest_drop(
    stack: Sequence[StandingObject], depth: float, config: PackingConfig, gripper: GripperGeometry
) -> float:
    """How far above its rest the last bowl of a stack is let go: the outer finger clears all lower rims."""
    heights = nest_heights(stack)
    upper = stack[-1]
    rims = max(height + bowl.top for height, bowl in zip(heights[:-1], stack[:-1]))
    fingertip = heights[-1] + upper.top - depth - gripper.tip
    return float(np.clip(rims - fingertip + 0.006, config.release_height, config.max_drop))


def _choices(problem: _Problem, wall_gap: float) -> list[_Choice]:
    """Mug lines along each wall and both diagonals, handle directions, corners to fill from."""
    box, config = problem.box, problem.config
    mugs = [item.name for item in problem.items.values() if item.category == "mug"]
    half = np.array(box.size[:2]) / 2 - wall_gap
    corners = tuple(itertools.product((-1.0, 1.0), (-1.0, 1.0)))
    if not mugs:
        return [_Choice((0, 0), (1, 0), 0.0, corner) for corner in corners]
    choices = []
    yaws = 2 * np.pi * np.arange(config.n_handle_directions) / config.n_handle_directions
    for yaw in yaws:
        turned = [problem.shapes.turned(mug, float(yaw)) for mug in mugs]
        for axis, side in itertools.product((0, 1), (-1.0, 1.0)):
            wall = np.zeros(2)
            wall[axis] = side
            # A cell to spare, for the raster's rounding.
            point = wall * (half[axis] - problem.cell - max(mug.reach(wall) for mug in turned))
            along = (0.0, 1.0) if axis == 0 else (1.0, 0.0)
            # The others start from the wall opposite the mugs.
            for sign in (-1.0, 1.0):
                corner = (-side, sign) if axis == 0 else (sign, -side)
                choices.append(_Choice((float(point[0]), float(point[1])), along, float(yaw), corner))
        if len(mugs) > 2:
            diagonal = half / np.linalg.norm(half)
            for sign in (-1.0, 1.0):
                direction = (float(diagonal[0]), float(sign * diagonal[1]))
                choices.append(_Choice((0.0, 0.0), direction, float(yaw), (-1.0, sign)))
    return choices


def _lay_out(problem: _Problem, choice: _Choice, gap: float, empty: BoxRaster, allowed: int) -> _Layout:
    """Stand everything greedily: the line of mugs, then bowls, bottles and cans, wide ones first.

    Given up half-way where more than ``allowed`` objects do not fit.
    """
    layout = _Layout(empty.copy())
    items = problem.items.values()
    line_cost = _line_cost(layout.raster, choice)
    for mug in sorted((i for i in items if i.category == "mug"), key=lambda i: -i.size):
        _stand(layout, problem, mug.name, (choice.handle_yaw,), line_cost, gap)
        if len(layout.left_out) > allowed:
            return layout
    cost = _corner_cost(layout.raster, choice)
    for stack in problem.stacks:
        lowest = stack[0].name
        _stand(layout, problem, lowest, (0.0,), cost, gap)
        for bowl in stack[1:]:
            if lowest in layout.positions:
                layout.cells[bowl.name], layout.yaws[bowl.name] = layout.cells[lowest], 0.0
                layout.positions[bowl.name] = layout.positions[lowest]
            else:
                layout.left_out.append(bowl.name)
    for item in sorted((i for i in items if i.category not in ("mug", "bowl")), key=lambda i: -_plan_size(i)):
        _stand(layout, problem, item.name, (0.0,) if item.is_round else (0.0, np.pi / 2), cost, gap)
        if len(layout.left_out) > allowed:
            return layout
    if not layout.left_out:
        _judge_releases(layout, problem)
    return layout


def _stand(
    layout: _Layout, problem: _Problem, name: str, yaws: Sequence[float], cost: np.ndarray, gap: float
) -> None:
    """Put the object on the free cell of least cost in the first yaw that fits, or note that none does."""
    for yaw in yaws:
        stencil = problem.shapes.stencil(name, yaw, gap)
        free = layout.raster.free_positions(stencil) & np.isfinite(cost)
        if free.any():
            i, j = np.unravel_index(np.argmin(np.where(free, cost, np.inf)), free.shape)
            layout.raster.add(stencil, (int(i), int(j)))
            layout.cells[name], layout.yaws[name] = (int(i), int(j)), yaw
            layout.positions[name] = np.array([layout.raster.x[i], layout.raster.y[j]])
            return
    layout.left_out.append(name)


def _line_cost(raster: BoxRaster, choice: _Choice) -> Float[np.ndarray, "nx ny"]:
    """Progress along the mugs' line for the cells on it, infinite elsewhere."""
    cells = raster.centers - np.array(choice.line_point)
    direction = np.array(choice.line_direction)
    off_line = np.abs(cells @ np.array([-direction[1], direction[0]]))
    return np.where(off_line <= 0.5001 * raster.cell, cells @ direction, np.inf)


def _corner_cost(raster: BoxRaster, choice: _Choice) -> Float[np.ndarray, "nx ny"]:
    """Distance from the chosen corner, along both walls."""
    return -(raster.centers @ (np.array([1.0, 1.05]) * choice.corner))


def _plan_size(item: StandingObject) -> float:
    return float(np.ptp(item.vertices[:, :2], axis=0).max())


def _judge_releases(layout: _Layout, problem: _Problem) -> None:
    """Count, in the order of execution, the grasps with which the hand can let go of each object."""
    nested = {bowl.name for stack in problem.stacks for bowl in stack[1:]}
    raster = BoxRaster(problem.box, 0.0, problem.cell)
    base = problem.box.floor + problem.config.release_height
    for name in problem.order:
        yaw = layout.yaws[name]
        if name not in nested:  # a nested bowl is let go above all rims
            count = count_releases(
                raster, problem.grasps[name], layout.positions[name], yaw, base, problem.grasp_config.gripper
            )
            layout.n_blocked += count == 0
            layout.freedom += min(count, problem.config.wanted_releases)
        raster.add(problem.shapes.stencil(name, yaw, 0.0), layout.cells[name], problem.box.floor)


def _rank(layout: _Layout, problem: _Problem) -> tuple[float, ...]:
    """Lower is better: what is left out, what is blocked, then freedom to let go, then area."""
    if layout.left_out:
        return (len(layout.left_out), 0.0, 0.0, 0.0)
    shapes = [problem.shapes.turned(name, layout.yaws[name]) for name in layout.positions]
    area = bounding_area(shapes, list(layout.positions.values()))
    return (len(layout.left_out), layout.n_blocked, -layout.freedom, area)


def _placements(problem: _Problem, layout: _Layout) -> tuple[Placement, ...]:
    by_name, grasps, box, config = problem.items, problem.grasps, problem.box, problem.config
    below = {
        bowl.name: tuple(other.name for other in stack[:index])
        for stack in problem.stacks
        for index, bowl in enumerate(stack)
    }
    placements = []
    for name in problem.order:
        if name not in layout.positions:
            continue
        x, y = layout.positions[name] + np.array(box.center)
        placement = Placement(
            name=name,
            position=(float(x), float(y), box.floor),
            yaws=admissible_yaws(by_name[name], layout.yaws[name]),
            stack=below.get(name, ()),
            release_height=config.release_height,
        )
        if placement.stack:
            stack = [by_name[n] for n in (*placement.stack, name)]
            depth = grasps[name][0].depth if grasps[name] else problem.grasp_config.bowl_depth
            drop = nest_drop(stack, depth, config, problem.grasp_config.gripper)
            placement = replace(placement, release_height=drop)
        placements.append(placement)
    return tuple(placements)


def admissible_yaws(item: StandingObject, yaw: float) -> tuple[float, ...]:
    """All yaws that look like ``yaw``: any for round objects, two for flat bottles, one for mugs."""
    if item.category == "mug":
        return (yaw,)
    if item.is_round:
        return tuple(float(yaw + turn) for turn in 2 * np.pi * np.arange(16) / 16)
    return (yaw, yaw + np.pi)
