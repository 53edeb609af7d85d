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

from manipulation.errors import PlanningError
from manipulation.footprints import BoxRaster, bounding_area
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.nesting import RadialProfile, nest_heights, radial_profile, stack_bowls
from manipulation.packing_problem import PackingConfig, PackingProblem, ShapeCache
from manipulation.packing_strategies import Strategy, corner_cost, line_cost, strategies
from manipulation.release_clearance import ReleasePose, count_free_releases
from manipulation.robot import GripperGeometry
from manipulation.types import Box, GraspSet, Placement, StandingObject

_ABOVE_RIM = 0.006  # [m] of a lower bowl, from which on a fingertip is clear of it


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
    problem = PackingProblem(
        {item.name: item for item in items},
        stacks, grasps, box, config, grasp_config, ShapeCache(items, cell), cell,
    )  # fmt: skip
    best: _Layout | None = None
    for gap, wanted in itertools.product(config.gaps, config.wall_gaps):
        if wanted > config.wall_gaps[0] and (best is None or best.left_out or wanted > narrowest):
            continue  # larger wall gaps help only where all objects fit but a release is blocked
        # What swings a little in the fingers meets a wall as it meets a neighbour.
        wall_gap = max(wanted, min(gap, config.roomy_wall_gap))
        # Stencils keep ``gap`` from occupied cells; the walls are moved so that ``wall_gap`` remains.
        empty = BoxRaster(box, wall_gap - gap)
        for strategy in strategies(problem, wall_gap):
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

    The outer finger, ``depth`` [m] below the bowl's rim, then clears all lower rims: it is above them, or
    there is room for it between the walls. What falls far is caught by that finger, on one side.
    """
    heights = nest_heights(stack)
    profiles = [radial_profile(bowl) for bowl in stack]
    upper = stack[-1]
    rims = max(height + bowl.top for height, bowl in zip(heights[:-1], stack[:-1]))
    tip = heights[-1] + upper.top - depth - gripper.tip  # of the finger when the bowl rests
    above = float(np.clip(rims - tip + _ABOVE_RIM, config.release_height, config.max_drop))
    across = config.nest_opening + gripper.pad_thickness + config.nest_clearance
    for drop in np.arange(config.release_height, above, 0.002):
        z = np.arange(tip + drop, rims + _ABOVE_RIM, 0.002)
        finger = across + np.interp(z - heights[-1] - drop, profiles[-1].heights, profiles[-1].outer)
        if all(
            (finger <= _cavity(profile, bowl.top, z - height)).all()
            for profile, bowl, height in zip(profiles[:-1], stack[:-1], heights[:-1])
        ):
            return float(drop)
    return above


def _cavity(profile: RadialProfile, rim: float, heights: np.ndarray) -> np.ndarray:
    """Return the inner radius [m] at heights [m] above the support; infinite clearly above the rim [m]."""
    inner = np.interp(heights, profile.heights, profile.inner)
    return np.where(heights > rim + _ABOVE_RIM - 1e-6, np.inf, inner)


def _lay_out(
    problem: PackingProblem, strategy: Strategy, gap: float, empty: BoxRaster, allowed: int
) -> _Layout:
    """Place all objects greedily: the line of mugs, then bowls, bottles and cans, wide ones first.

    Stops as soon as more than ``allowed`` objects do not fit.
    """
    layout = _Layout(empty.copy())
    items = problem.items.values()
    on_line = line_cost(layout.raster, strategy)
    for mug in sorted((i for i in items if i.category == "mug"), key=lambda i: -i.size):
        _place(layout, problem, mug.name, (strategy.handle_yaw,), on_line, gap)
        if len(layout.left_out) > allowed:
            return layout
    cost = corner_cost(layout.raster, strategy)
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
    layout: _Layout, problem: PackingProblem, name: str, yaws: Sequence[float], cost: np.ndarray, gap: float
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


def _top_view_size(item: StandingObject) -> float:
    """Return the larger horizontal extent in [m]."""
    return float(np.ptp(item.vertices[:, :2], axis=0).max())


def _count_releases(layout: _Layout, problem: PackingProblem) -> None:
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


def _rank(layout: _Layout, problem: PackingProblem) -> tuple[float, ...]:
    """Return the sort key of a layout, lower is better: left-out objects, blocked ones, releases, area."""
    if layout.left_out:
        return (len(layout.left_out), 0.0, 0.0, 0.0)
    shapes = [problem.shapes.rotated(name, layout.yaws[name]) for name in layout.positions]
    area = bounding_area(shapes, list(layout.positions.values()))
    return (len(layout.left_out), layout.n_blocked, -layout.freedom, area)


def _placements(problem: PackingProblem, layout: _Layout) -> tuple[Placement, ...]:
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
