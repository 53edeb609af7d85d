"""Layouts for crowded boxes: objects at random places that are pushed apart until none overlaps.

Greedy layouts leave gaps between objects of unlike sizes, which no object fits into. Here all places vary at
the same time. The distance between two convex outlines A at p and B at q, along fixed directions d, is

    s = max_d  d·(q - p) - h_A(d) - h_B(-d),    h_A(d) = max_{a in A} d·a    (support functions),

and the energy is the sum of max(0, gap - s)² over all pairs, of the same penalty for the walls, and for mugs
farther from their common line than a tolerance. Many random starts descend it side by side.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from manipulation.footprints import BoxRaster, Footprint
from manipulation.layouts import Layout
from manipulation.packing_problem import PackingProblem
from manipulation.packing_strategies import yaws_of

_DIRECTIONS = 48
_STEPS = 120  # at each gap
_RATE, _INERTIA = 0.4, 0.7  # of the descent; the energy's curvature is about 1 for each contact
_KICK = 0.003  # [m], standard deviation of the random steps at the beginning, which decay
_KICKED = 0.6  # share of the steps with random ones
_SLACK = 0.0008  # [m] by which a distance may fall short of the gap in the end


@dataclass(frozen=True)
class Parts:
    """Convex outlines of n objects in s starts.

    Attributes:
        owner: (k,) object of each outline.
        pairs: (2, m) outlines of different objects.
        directions: (d, 2) unit vectors; the opposite of one is half their number ahead.
        support: (s, k, d) support functions in [m].
        mugs: (n,) which objects belong to the row of mugs.
    """

    owner: Int[np.ndarray, "k"]
    pairs: Int[np.ndarray, "2 m"]
    directions: Float[np.ndarray, "d 2"]
    support: Float[np.ndarray, "s k d"]
    mugs: Bool[np.ndarray, "n"]

    @staticmethod
    def of(shapes: Sequence[Sequence[Footprint]], mugs: Bool[np.ndarray, "n"]) -> Parts:
        """Return the outlines of the objects' footprints, which are given for each start."""
        angle = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        directions = np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)
        owner = np.repeat(np.arange(len(mugs)), [len(shape.outlines) for shape in shapes[0]])
        pairs = [(a, b) for a, b in itertools.combinations(range(len(owner)), 2) if owner[a] != owner[b]]
        support = [
            [(outline @ directions.T).max(axis=0) for shape in start for outline in shape.outlines]
            for start in shapes
        ]
        paired = np.array(pairs, dtype=int).reshape(-1, 2).T
        return Parts(owner, paired, directions, np.array(support, np.float32), mugs)

    @cached_property
    def reach(self) -> Float[np.ndarray, "s m d"]:
        """h_A(d) + h_B(-d) of each pair in [m]: how far apart along d their origins are when they touch."""
        (a, b), ahead = self.pairs, _DIRECTIONS // 2
        opposite = np.concatenate([self.support[..., ahead:], self.support[..., :ahead]], axis=2)
        return self.support[:, a] + opposite[:, b]

    def chosen(self, starts: Int[np.ndarray, "c"]) -> Parts:
        """Return the outlines of some of the starts."""
        return replace(self, support=self.support[starts])


@dataclass(frozen=True)
class Room:
    """What a layout must keep, in [m].

    Attributes:
        half: (2,) half sides of the inside of the box without the distance from the walls.
        gap: distance between objects.
        row_width: largest distance of a mug from the common line of the mugs.
    """

    half: Float[np.ndarray, "2"]
    gap: float
    row_width: float


@dataclass(frozen=True)
class _Starts:
    """Layouts that are relaxed side by side: outlines, yaws (s, n) in [rad] and places (s, n, 2) in [m]."""

    parts: Parts
    yaws: Float[np.ndarray, "s n"]
    places: Float[np.ndarray, "s n 2"]


class Relaxation:
    """Random layouts of all objects of a problem, which are relaxed at smaller and smaller gaps.

    Each gap begins with the better half of the layouts at the gap before. The same problem and gaps give the
    same layouts.
    """

    def __init__(self, problem: PackingProblem) -> None:
        self._problem = problem
        self._rng = np.random.default_rng(problem.config.seed)
        self._items = [item for name, item in problem.items.items() if name not in problem.nested]
        self._mugs = np.array([item.category == "mug" for item in self._items])
        self._starts: _Starts | None = None

    def layouts(
        self, gap: float, wall_gap: float, afresh: bool = False, in_row: bool = True
    ) -> Iterator[Layout]:
        """Yield the layouts without overlap when objects keep ``gap`` and ``wall_gap`` [m].

        Args:
            gap, wall_gap: distances between objects and from the walls in [m].
            afresh: whether to begin with new random layouts.
            in_row: whether all mugs stand in one row.
        """
        problem, starts = self._problem, self._starts
        row_width = problem.config.row_width if in_row else np.inf
        room = Room(np.array(problem.box.size[:2]) / 2 - wall_gap, gap, row_width)
        if starts is None or afresh:
            starts = self._random_starts(room.half)
        places, violation = relax(starts.parts, starts.places, room, self._rng)
        order = np.argsort(violation, kind="stable")
        better = order[: max(len(order) // 2, problem.config.n_relaxed // 4)]
        self._starts = _Starts(starts.parts.chosen(better), starts.yaws[better], places[better])
        for start in order[violation[order] <= _SLACK]:
            yield self._layout(starts.yaws[start].tolist(), places[start].astype(np.float64))

    def _random_starts(self, half: Float[np.ndarray, "2"]) -> _Starts:
        count = self._problem.config.n_relaxed
        yaws = np.array([self._random_yaws() for _ in range(count)])
        shapes = [
            [self._problem.shapes.rotated(item.name, yaw) for item, yaw in zip(self._items, row, strict=True)]
            for row in yaws.tolist()
        ]
        places = self._rng.uniform(-half, half, (count, len(self._items), 2)).astype(np.float32)
        return _Starts(Parts.of(shapes, self._mugs), yaws, places)

    def _random_yaws(self) -> list[float]:
        """Return a yaw [rad] for each object, the same for all mugs."""
        handle = self._rng.uniform(-np.pi, np.pi)
        return [
            handle if item.category == "mug" else float(self._rng.choice(yaws_of(item)))
            for item in self._items
        ]

    def _layout(self, yaws: Sequence[float], places: Float[np.ndarray, "n 2"]) -> Layout:
        problem = self._problem
        layout = Layout(problem, BoxRaster(problem.box, 0.0, problem.cell))
        for item, yaw, place in zip(self._items, yaws, places, strict=True):
            layout.put(item.name, place, yaw)
        for stack in problem.stacks:
            layout.nest(stack)
        layout.count_releases()
        return layout


def relax(
    parts: Parts, places: Float[np.ndarray, "s n 2"], room: Room, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "s n 2"], Float[np.ndarray, "s"]]:
    """Push overlapping objects apart, with random steps at first that lead out of local minima.

    Args:
        parts: convex outlines.
        places: places of the objects in [m], relative to the box's centre.
        room: distances to keep.
        rng: source of the random steps.

    Returns:
        The places in the end, and the largest violation of a distance in [m] in each start.
    """
    velocity = np.zeros_like(places)
    for step in range(_STEPS):
        velocity = _INERTIA * velocity + _RATE * _pushes(parts, places, room)[0]
        kick = _KICK * max(1.0 - step / (_KICKED * _STEPS), 0.0)
        if kick:
            velocity += kick * rng.standard_normal(places.shape, dtype=np.float32)
        places = places + velocity
    return places, _pushes(parts, places, room)[1]


def _pushes(
    parts: Parts, places: Float[np.ndarray, "s n 2"], room: Room
) -> tuple[Float[np.ndarray, "s n 2"], Float[np.ndarray, "s"]]:
    """Return the push on each object and the largest violation of each start, in [m].

    The push is the negative gradient of the energy: a quarter of the squared shortfalls between objects, half
    of those at walls and at the row of mugs.
    """
    (a, b), directions = parts.pairs, parts.directions
    at = places[:, parts.owner]
    apart = (at[:, b] - at[:, a]) @ directions.T - parts.reach  # (s, m, d)
    best = apart.argmax(axis=2)
    short = np.maximum(room.gap - np.take_along_axis(apart, best[..., None], 2)[..., 0], 0.0)
    force = 0.5 * short[..., None] * directions[best]
    push = np.zeros_like(places)
    for k, (i, j) in enumerate(zip(parts.owner[a], parts.owner[b], strict=True)):
        push[:, i] -= force[:, k]
        push[:, j] += force[:, k]
    reach = parts.support[..., :: _DIRECTIONS // 4]  # along +x, +y, -x, -y
    above = np.maximum(at + reach[..., :2] - room.half, 0.0)
    below = np.maximum(reach[..., 2:] - at - room.half, 0.0)
    for k, i in enumerate(parts.owner):
        push[:, i] += below[:, k] - above[:, k]
    violation = np.maximum(
        short.max(axis=1, initial=0.0), np.maximum(above, below).max(axis=(1, 2), initial=0.0)
    )
    if parts.mugs.sum() > 2:
        inwards = _towards_row(places[:, parts.mugs], room.row_width)
        push[:, parts.mugs] += inwards
        violation = np.maximum(violation, np.linalg.norm(inwards, axis=2).max(axis=1))
    return push.astype(np.float32), violation


def _towards_row(centres: Float[np.ndarray, "s n 2"], row_width: float) -> Float[np.ndarray, "s n 2"]:
    """Return the way of each mug [m] to within ``row_width`` [m] of their line of least squares."""
    offset = centres - centres.mean(axis=1, keepdims=True)
    across = np.linalg.eigh(np.einsum("sni,snj->sij", offset, offset))[1][:, :, 0]
    off = np.einsum("sni,si->sn", offset, across)
    excess = np.sign(off) * np.maximum(np.abs(off) - row_width, 0.0)
    return -excess[..., None] * across[:, None]
