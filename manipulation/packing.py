"""Layout of objects in a box: nested bowls, mugs in a line with equal handle directions, cans and bottles.

Objects are placed on a raster, greedily for many strategies (line of the mugs, direction of their handles,
first corner, gaps), then in random order where a box is crowded. Layouts are ranked by the number of objects
that fit and have a collision-free release in the order of execution, the number of releases, and the area.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from manipulation.errors import PlanningError
from manipulation.footprints import BoxRaster
from manipulation.grasp_config import GraspConfig
from manipulation.grasps import grasp_candidates
from manipulation.layouts import Layout, unreleasable
from manipulation.nesting import RadialProfile, nest_heights, radial_profile, stack_bowls
from manipulation.packing_problem import PackingConfig, PackingProblem, ShapeCache, placed_later
from manipulation.packing_strategies import greedy_layout, strategies
from manipulation.relaxed_layouts import Relaxation
from manipulation.robot import GripperGeometry
from manipulation.types import Box, GraspSet, Placement, StandingObject

_ABOVE_RIM = 0.006  # [m] of a lower bowl, from which on a fingertip is clear of it


def pack(
    items: Sequence[StandingObject],
    box: Box,
    config: PackingConfig = PackingConfig(),
    grasp_config: GraspConfig = GraspConfig(),
    grasps: Mapping[str, GraspSet] | None = None,
    resting: Mapping[str, str] | None = None,
) -> tuple[tuple[Placement, ...], dict[str, str]]:
    """Search for a layout of objects in a box.

    Args:
        items: objects.
        box: box.
        config: settings of the search.
        grasp_config: settings of grasp generation.
        grasps: grasp candidates by name; generated if None.
        resting: by the name of an object, that of the one that it rests on now, and that comes after it.

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
    problem = PackingProblem(
        {item.name: item for item in items},
        stacks, grasps, box, config, grasp_config, ShapeCache(items, cell), cell,
        placed_later(resting or {}, {item.name: () for item in items} | _below(stacks)),
    )  # fmt: skip
    best = _best_layout(problem)
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


@dataclass(frozen=True)
class _Search:
    """A search for layouts: kind, distance between objects in [m], least distance from the walls in [m].

    Only the last relaxed layouts need not have all mugs in one row.
    """

    kind: Literal["greedy", "relaxed", "restarted"]
    gap: float
    wall_gap: float
    in_row: bool = True


def _best_layout(problem: PackingProblem) -> Layout:
    """Return the layout of the best rank of the searches, which end with the first complete one."""
    config = problem.config
    hopeless = cache(partial(unreleasable, problem))
    relaxation = Relaxation(problem)
    best: Layout | None = None

    def is_complete(layout: Layout) -> bool:
        return not layout.left_out and (not layout.blocked or hopeless().issuperset(layout.blocked))

    for search in _searches(config):
        crowded = best is None or bool(best.left_out)
        if search.wall_gap > config.wall_gaps[0] and (crowded or search.wall_gap > problem.narrowest):
            continue  # larger wall gaps help only where all objects fit but a release is blocked
        for layout in _layouts(problem, search, relaxation, best):
            if best is None or layout.rank() < best.rank():
                best = layout
            if search.kind != "greedy" and is_complete(layout):
                break
        if best is not None and is_complete(best):
            break
    assert best is not None
    return best


def _searches(config: PackingConfig) -> Iterator[_Search]:
    """Yield the searches in order: first what is neat, then what leaves the most room."""
    n_roomy = max(1, sum(gap >= config.roomy_gap for gap in config.gaps))
    roomy, tight = config.gaps[:n_roomy], config.gaps[n_roomy:]
    near = config.wall_gaps[0]
    yield from (_Search("greedy", gap, wall) for gap in roomy for wall in config.wall_gaps)
    yield from (_Search("relaxed", gap, near) for gap in roomy)
    for gap in tight:
        yield _Search("relaxed", gap, near)
        yield from (_Search("greedy", gap, wall) for wall in config.wall_gaps)
    for restart in range(2 * config.n_restarts):
        in_row, is_last = restart < config.n_restarts, restart == 2 * config.n_restarts - 1
        for index, gap in enumerate((*tight, config.least_gap) if is_last else tight):
            yield _Search("relaxed" if index else "restarted", gap, near, in_row)


def _layouts(
    problem: PackingProblem, search: _Search, relaxation: Relaxation, best: Layout | None
) -> Iterator[Layout]:
    """Yield the layouts of a search; greedy ones are given up where they are worse than the best so far."""
    # What swings a little in the fingers meets a wall as it meets a neighbour.
    wall_gap = max(search.wall_gap, min(search.gap, problem.config.roomy_wall_gap))
    if search.kind != "greedy":
        yield from relaxation.layouts(search.gap, wall_gap, search.kind == "restarted", search.in_row)
        return
    # Stencils keep the gap from occupied cells; the walls are moved so that ``wall_gap`` remains.
    empty = BoxRaster(problem.box, wall_gap - search.gap)
    allowed = len(problem.items) if best is None else best.missing
    for strategy in strategies(problem, wall_gap):
        layout = greedy_layout(problem, strategy, search.gap, empty, allowed)
        allowed = min(allowed, layout.missing)
        yield layout


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
    for drop in np.arange(config.release_height, above, 0.002):
        z = np.arange(tip + drop, rims + _ABOVE_RIM, 0.002)
        across = config.nest_opening + _finger_thickness(gripper, z - tip - drop) + config.nest_clearance
        finger = across + np.interp(z - heights[-1] - drop, profiles[-1].heights, profiles[-1].outer)
        if all(
            (finger <= _cavity(profile, bowl.top, z - height)).all()
            for profile, bowl, height in zip(profiles[:-1], stack[:-1], heights[:-1])
        ):
            return float(drop)
    return above


def _finger_thickness(gripper: GripperGeometry, heights: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Return the thickness [m] of a finger at heights [m] above its tip; it grows along the pad."""
    above_pad = gripper.tip + gripper.pad_half_height
    return np.interp(heights, [0.0, above_pad], [gripper.pad_thickness, gripper.finger_thickness])


def _cavity(profile: RadialProfile, rim: float, heights: np.ndarray) -> np.ndarray:
    """Return the inner radius [m] at heights [m] above the support; infinite clearly above the rim [m]."""
    inner = np.interp(heights, profile.heights, profile.inner)
    return np.where(heights > rim + _ABOVE_RIM - 1e-6, np.inf, inner)


def _placements(problem: PackingProblem, layout: Layout) -> tuple[Placement, ...]:
    """Return the placements of a layout in the order of execution."""
    by_name, grasps, box, config = problem.items, problem.grasps, problem.box, problem.config
    below = _below(problem.stacks)
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


def _below(stacks: Sequence[Sequence[StandingObject]]) -> dict[str, tuple[str, ...]]:
    """Return the names of the bowls that each bowl goes into, from the lowest up."""
    return {
        bowl.name: tuple(other.name for other in stack[:index])
        for stack in stacks
        for index, bowl in enumerate(stack)
    }


def admissible_yaws(item: StandingObject, yaw: float) -> tuple[float, ...]:
    """Return the yaws equivalent to ``yaw`` [rad]: 16 for round objects, two for flat ones, one for mugs."""
    if item.category == "mug":
        return (yaw,)
    if item.is_round:
        return tuple(float(yaw + offset) for offset in 2 * np.pi * np.arange(16) / 16)
    return (yaw, yaw + np.pi)
