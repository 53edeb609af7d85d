"""Greedy layouts: the mugs in a line with equal handle directions, then wide objects first from a corner."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from manipulation.footprints import BoxRaster
from manipulation.layouts import Cost, Layout
from manipulation.packing_problem import PackingProblem
from manipulation.types import RIMMED, StandingObject


@dataclass(frozen=True)
class Strategy:
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


def strategies(problem: PackingProblem, wall_gap: float) -> list[Strategy]:
    """Return the strategies: mug lines along each wall and both diagonals, handle directions, corners."""
    box, config = problem.box, problem.config
    mugs = [item.name for item in problem.items.values() if item.category == "mug"]
    half = np.array(box.size[:2]) / 2 - wall_gap
    corners = tuple(itertools.product((-1.0, 1.0), (-1.0, 1.0)))
    if not mugs:
        return [Strategy((0, 0), (1, 0), 0.0, corner) for corner in corners]
    found = []
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
                found.append(Strategy((float(point[0]), float(point[1])), along, float(yaw), corner))
        if len(mugs) > 2:
            diagonal = half / np.linalg.norm(half)
            for sign in (-1.0, 1.0):
                direction = (float(diagonal[0]), float(sign * diagonal[1]))
                found.append(Strategy((0.0, 0.0), direction, float(yaw), (-1.0, sign)))
    return found


def greedy_layout(
    problem: PackingProblem, strategy: Strategy, gap: float, empty: BoxRaster, allowed: int
) -> Layout:
    """Return a layout at a gap [m], given up as soon as more than ``allowed`` objects do not fit."""
    layout = Layout(problem, empty.copy())
    items = problem.items.values()
    on_line = line_cost(layout.raster, strategy)
    for mug in sorted((i for i in items if i.category == "mug"), key=lambda i: -i.size):
        layout.place(mug.name, (strategy.handle_yaw,), on_line, gap)
        if len(layout.left_out) > allowed:
            return layout
    cost = corner_cost(layout.raster, strategy.corner)
    for stack in problem.stacks:
        layout.place(stack[0].name, yaws_of(stack[0]), cost, gap)
        layout.nest(stack)
    others = (i for i in items if i.category not in RIMMED)
    for item in sorted(others, key=lambda i: -problem.shapes.width(i.name)):
        layout.place(item.name, yaws_of(item), cost, gap)
        if len(layout.left_out) > allowed:
            return layout
    layout.count_releases()
    return layout


def yaws_of(item: StandingObject) -> tuple[float, ...]:
    """Return the yaws [rad] at which an object other than a mug is tried."""
    return (0.0,) if item.is_round or item.category == "bowl" else (0.0, np.pi / 2)


def line_cost(raster: BoxRaster, strategy: Strategy) -> Cost:
    """Return the position along the mugs' line of the cells on it, infinity elsewhere."""
    cells = raster.centers - np.array(strategy.line_point)
    direction = np.array(strategy.line_direction)
    off_line = np.abs(cells @ np.array([-direction[1], direction[0]]))
    return np.where(off_line <= 0.5001 * raster.cell, cells @ direction, np.inf)


def corner_cost(raster: BoxRaster, corner: tuple[float, float]) -> Cost:
    """Return the distance from the corner with these signs along both walls [m], up to a constant."""
    return -(raster.centers @ (np.array([1.0, 1.05]) * corner))
