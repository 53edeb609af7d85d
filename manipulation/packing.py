"""Layout of objects in a box: nested bowls, mugs in a line with equal handle directions, cans and bottles.

Objects are placed greedily on a raster for many strategies (line of the mugs, direction of their handles,
first corner, gaps). Layouts are ranked by the number of objects that fit, the number of collision-free
releases in the order of execution, and the occupied area.
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
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.robot import GripperGeometry
from manipulation.types import Box, GraspSet, Placement, StandingObject


@dataclass(frozen=True)
class PackingConfig:
    """Settings of the layout search.

    Attributes:
        gaps: distances between objects in [m], tried in order.
        wall_gaps: distances from the walls in [m]; the larger ones are for objects that a wall keeps the hand
            from releasing.
        release_height: height above the floor at which an object is released, in [m].
        max_drop: largest height above its resting pose at which a nested bowl is released, in [m].
        enough_releases: number of collision-free releases of an object beyond which more do not count.
        n_handle_directions: number of handle directions.
    """

    gaps: tuple[float, ...] = (0.024, 0.020, 0.016, 0.012, 0.008, 0.005)
    wall_gaps: tuple[float, ...] = (0.008, 0.04, 0.075)
    release_height: float = 0.003
    max_drop: float = 0.044
    enough_releases: int = 4
    n_handle_directions: int = 8


class _Shapes:
    """Cache of the objects' footprints and stencils by yaw and gap."""

    def __init__(self, items: Sequence[StandingObject], cell: float) -> None:
        self._footprints = {item.name: footprint(item) for item in items}
        self._cell = cell
        self._rotated: dict[tuple[str, float], Footprint] = {}
        self._stencils: dict[tuple[str, float, float], Stencil] = {}

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


@dataclass(frozen=True)
class _Problem:
    """Input of the layout search: objects by name, stacks of bowls, grasps, box, settings."""

    items: Mapping[str, StandingObject]
    stacks: Sequence[Sequence[StandingObject]]
    grasps: Mapping[str, GraspSet]
    box: Box
    config: PackingConfig
    grasp_config: GraspConfig
    shapes: _Shapes
    cell: float

    @property
    def order(self) -> list[str]:
        """Order of execution: bowls from the largest up, then the others by height to keep the hand above."""
        bowls = [bowl.name for stack in self.stacks for bowl in stack]
        others = sorted((i for i in self.items.values() if i.category != "bowl"), key=lambda i: i.top)
        return bowls + [item.name for item in others]


@dataclass
class _Layout:
    """A partial layout.

    Attributes:
        raster: occupied cells.
        cells, positions, yaws: cell, position relative to the box's centre in [m] and yaw in [rad] by name.
        left_out: names of the objects that do not fit.
        n_blocked: number of objects without a collision-free release.
        freedom: number of collision-free releases, limited for each object.
    """

    raster: BoxRaster
    cells: dict[str, tuple[int, int]] = field(default_factory=dict)
    positions: dict[str, np.ndarray] = field(default_factory=dict)
    yaws: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    n_blocked: int = 0
    freedom: int = 0


@dataclass(frozen=True)
class _Strategy:
    """Parameters of one greedy layout.

    Attributes:
        line_point, line_direction: line of the mugs' centres, relative to the box's centre, in [m].
        handle_yaw: direction of the handles in [rad].
        corner: signs of the corner from which the other objects are placed.
    """

    line_point: tuple[float, float]
    line_direction: tuple[float, float]
    handle_yaw: float
    corner: tuple[float, float]


def pack(
    items: Sequence[StandingObject],
    box: Box,
    config: PackingConfig = PackingConfig(),
    grasp_config: GraspConfig = GraspConfig(),
    grasps: Mapping[str, GraspSet] | None = None,
) -> tuple[tuple[Placement, ...], dict[str, str]]:
    """Search for a layout of objects in a box.

    Args:
        items: objects.
        box: box.
        config: settings of the search.
        grasp_config: settings of grasp generation.
        grasps: grasp candidates by name; generated if None.

    Returns:
        Placements in the order of execution, and the reason by name for each object that does not fit.

    Raises:
        PlanningError: there are no objects, or none of them fits.
    """
    if not items:
        raise PlanningError("no object to pack was perceived")
    if grasps is None:
        grasps = {item.name: grasp_candidates(item, grasp_config) for item in items}
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
            continue  # larger wall gaps help only where all objects fit but a release is blocked
        # Stencils keep ``gap`` from occupied cells; the walls are moved so that ``wall_gap`` remains.
        empty = BoxRaster(box, wall_gap - gap)
        for strategy in _strategies(problem, wall_gap):
            allowed = len(items) if best is None else len(best.left_out)
            layout = _lay_out(problem, strategy, gap, empty, allowed)
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
    """Return the height [m] above its resting pose at which the last bowl of a stack is released.

    The outer finger, ``depth`` [m] below the bowl's rim, then clears all lower rims.
    """
    heights = nest_heights(stack)
    upper = stack[-1]
    rims = max(height + bowl.top for height, bowl in zip(heights[:-1], stack[:-1]))
    fingertip = heights[-1] + upper.top - depth - gripper.tip
    return float(np.clip(rims - fingertip + 0.006, config.release_height, config.max_drop))


def _strategies(problem: _Problem, wall_gap: float) -> list[_Strategy]:
    """Return the strategies: mug lines along each wall and both diagonals, handle directions, corners."""
    box, config = problem.box, problem.config
    mugs = [item.name for item in problem.items.values() if item.category == "mug"]
    half = np.array(box.size[:2]) / 2 - wall_gap
    corners = tuple(itertools.product((-1.0, 1.0), (-1.0, 1.0)))
    if not mugs:
        return [_Strategy((0, 0), (1, 0), 0.0, corner) for corner in corners]
    strategies = []
    yaws = 2 * np.pi * np.arange(config.n_handle_directions) / config.n_handle_directions
    for yaw in yaws:
        rotated = [problem.shapes.rotated(mug, float(yaw)) for mug in mugs]
        for axis, side in itertools.product((0, 1), (-1.0, 1.0)):
            wall = np.zeros(2)
            wall[axis] = side
            # One cell less, for the rounding of the raster.
            point = wall * (half[axis] - problem.cell - max(mug.reach(wall) for mug in rotated))
            along = (0.0, 1.0) if axis == 0 else (1.0, 0.0)
            # The other objects start at the opposite wall.
            for sign in (-1.0, 1.0):
                corner = (-side, sign) if axis == 0 else (sign, -side)
                strategies.append(_Strategy((float(point[0]), float(point[1])), along, float(yaw), corner))
        if len(mugs) > 2:
            diagonal = half / np.linalg.norm(half)
            for sign in (-1.0, 1.0):
                direction = (float(diagonal[0]), float(sign * diagonal[1]))
                strategies.append(_Strategy((0.0, 0.0), direction, float(yaw), (-1.0, sign)))
    return strategies


def _lay_out(problem: _Problem, strategy: _Strategy, gap: float, empty: BoxRaster, allowed: int) -> _Layout:
    """Place all objects greedily: the line of mugs, then bowls, bottles and cans, wide ones first.

    Stops as soon as more than ``allowed`` objects do not fit.
    """
    layout = _Layout(empty.copy())
    items = problem.items.values()
    line_cost = _line_cost(layout.raster, strategy)
    for mug in sorted((i for i in items if i.category == "mug"), key=lambda i: -i.size):
        _place(layout, problem, mug.name, (strategy.handle_yaw,), line_cost, gap)
        if len(layout.left_out) > allowed:
            return layout
    cost = _corner_cost(layout.raster, strategy)
    for stack in problem.stacks:
        lowest = stack[0].name
        _place(layout, problem, lowest, (0.0,), cost, gap)
        for bowl in stack[1:]:
            if lowest in layout.positions:
                layout.cells[bowl.name], layout.yaws[bowl.name] = layout.cells[lowest], 0.0
                layout.positions[bowl.name] = layout.positions[lowest]
            else:
                layout.left_out.append(bowl.name)
    for item in sorted(
        (i for i in items if i.category not in ("mug", "bowl")), key=lambda i: -_top_view_size(i)
    ):
        _place(layout, problem, item.name, (0.0,) if item.is_round else (0.0, np.pi / 2), cost, gap)
        if len(layout.left_out) > allowed:
            return layout
    if not layout.left_out:
        _count_releases(layout, problem)
    return layout


def _place(
    layout: _Layout, problem: _Problem, name: str, yaws: Sequence[float], cost: np.ndarray, gap: float
) -> None:
    """Place the object at the free cell of least cost at the first yaw that fits, or exclude it."""
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


def _line_cost(raster: BoxRaster, strategy: _Strategy) -> Float[np.ndarray, "nx ny"]:
    """Return the position along the mugs' line of the cells on it, infinity elsewhere."""
    cells = raster.centers - np.array(strategy.line_point)
    direction = np.array(strategy.line_direction)
    off_line = np.abs(cells @ np.array([-direction[1], direction[0]]))
    return np.where(off_line <= 0.5001 * raster.cell, cells @ direction, np.inf)


def _corner_cost(raster: BoxRaster, strategy: _Strategy) -> Float[np.ndarray, "nx ny"]:
    """Return the distance from the strategy's corner along both walls, up to a constant."""
    return -(raster.centers @ (np.array([1.0, 1.05]) * strategy.corner))


def _top_view_size(item: StandingObject) -> float:
    """Return the larger horizontal extent in [m]."""
    return float(np.ptp(item.vertices[:, :2], axis=0).max())


def _count_releases(layout: _Layout, problem: _Problem) -> None:
    """Count the collision-free releases of each object in the order of execution."""
    nested = {bowl.name for stack in problem.stacks for bowl in stack[1:]}
    raster = BoxRaster(problem.box, 0.0, problem.cell)
    base = problem.box.floor + problem.config.release_height
    for name in problem.order:
        yaw = layout.yaws[name]
        if name not in nested:  # a nested bowl is released above all rims
            pose = ReleasePose(layout.positions[name], yaw, base)
            grasps = problem.grasps[name].grasps
            count = count_free_releases(raster, grasps, pose, problem.grasp_config.gripper)
            layout.n_blocked += count == 0
            layout.freedom += min(count, problem.config.enough_releases)
        raster.add(problem.shapes.stencil(name, yaw, 0.0), layout.cells[name], problem.box.floor)


def _rank(layout: _Layout, problem: _Problem) -> tuple[float, ...]:
    """Return the sort key of a layout, lower is better: left-out objects, blocked ones, releases, area."""
    if layout.left_out:
        return (len(layout.left_out), 0.0, 0.0, 0.0)
    shapes = [problem.shapes.rotated(name, layout.yaws[name]) for name in layout.positions]
    area = bounding_area(shapes, list(layout.positions.values()))
    return (len(layout.left_out), layout.n_blocked, -layout.freedom, area)


def _placements(problem: _Problem, layout: _Layout) -> tuple[Placement, ...]:
    """Return the placements of a layout in the order of execution."""
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
            candidates = grasps[name].grasps
            depth = candidates[0].depth if candidates else problem.grasp_config.bowl_depth
            drop = nest_drop(stack, depth, config, problem.grasp_config.gripper)
            placement = replace(placement, release_height=drop)
        placements.append(placement)
    return tuple(placements)


def admissible_yaws(item: StandingObject, yaw: float) -> tuple[float, ...]:
    """Return the yaws equivalent to ``yaw`` [rad]: 16 for round objects, two for flat ones, one for mugs."""
    if item.category == "mug":
        return (yaw,)
    if item.is_round:
        return tuple(float(yaw + offset) for offset in 2 * np.pi * np.arange(16) / 16)
    return (yaw, yaw + np.pi)
