"""Search for a path between two postures where no simple one is free: RRT-Connect.

Two trees of postures grow towards each other from start and goal (Kuffner and LaValle, "RRT-Connect: an
efficient approach to single-query path planning", ICRA 2000). The path is then shortened by straight moves
between its waypoints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Posture = Float[np.ndarray, "n"]
IsFree = Callable[[Posture, Posture], bool]


@dataclass(frozen=True)
class SearchConfig:
    """Settings of the search.

    Attributes:
        step: largest joint step of a branch in [rad].
        spread: standard deviation of the sampled joint positions about the segment from start to goal in
            [rad]; postures far from it seldom help.
        max_samples: number of samples after which the search ends.
        shortcuts: number of pairs of waypoints between which a straight move is tried.
    """

    step: float = 0.3
    spread: float = 0.7
    max_samples: int = 300
    shortcuts: int = 40


class _Tree:
    """Postures [rad] with the index of the one that each was reached from."""

    def __init__(self, root: Posture) -> None:
        self.postures, self.parents = [root], [-1]

    def nearest(self, q: Posture) -> int:
        """Return the index of the posture from which a straight move to ``q`` is shortest."""
        return int(np.abs(np.array(self.postures) - q).max(axis=1).argmin())

    def add(self, q: Posture, parent: int) -> int:
        self.postures.append(q)
        self.parents.append(parent)
        return len(self.postures) - 1

    def branch(self, index: int) -> list[Posture]:
        """Return the postures from the root to one."""
        branch = []
        while index >= 0:
            branch.append(self.postures[index])
            index = self.parents[index]
        return branch[::-1]


def search_path(
    q_start: Posture,
    q_goal: Posture,
    is_free: IsFree,
    limits: tuple[Posture, Posture],
    config: SearchConfig = SearchConfig(),
) -> list[Posture] | None:
    """Return waypoints [rad] of free straight joint moves from start to goal; None if none were found.

    Both postures must be free. The same arguments give the same path.

    Args:
        q_start, q_goal: (n,) postures in [rad].
        is_free: whether the straight move between two postures is free of collisions, its end included.
        limits: smallest and largest joint positions in [rad].
        config: settings.
    """
    rng = np.random.default_rng(0)
    trees, from_start = (_Tree(np.asarray(q_start)), _Tree(np.asarray(q_goal))), True
    for _ in range(config.max_samples):
        growing, other = trees if from_start else trees[::-1]
        between = q_start + rng.uniform() * (np.asarray(q_goal) - q_start)
        sample = np.clip(between + config.spread * rng.standard_normal(len(between)), *limits)
        reached = _grow(growing, sample, is_free, config.step)
        if reached is not None:
            target = growing.postures[reached]
            met = _grow(other, target, is_free, config.step, to_target=True)
            if met is not None and np.array_equal(other.postures[met], target):
                there, back = growing.branch(reached), other.branch(met)[::-1]
                path = there + back[1:]
                return _shortened(path if from_start else path[::-1], is_free, rng, config.shortcuts)
        from_start = not from_start
    return None


def _grow(tree: _Tree, target: Posture, is_free: IsFree, step: float, to_target: bool = False) -> int | None:
    """Grow a branch towards a posture, by one step or as far as it is free; return its end, None if empty."""
    index, end = tree.nearest(target), None
    while True:
        q = tree.postures[index]
        distance = float(np.abs(target - q).max())
        if distance == 0.0:
            return index
        q_next = target if distance <= step else q + step / distance * (target - q)
        if not is_free(q, q_next):
            return end
        index = end = tree.add(q_next, index)
        if not to_target:
            return end


def _shortened(
    path: Sequence[Posture], is_free: IsFree, rng: np.random.Generator, shortcuts: int
) -> list[Posture]:
    """Return a path without the waypoints that straight moves between others make superfluous."""
    path = list(path)
    for _ in range(shortcuts):
        if len(path) <= 2:
            break
        first = int(rng.integers(0, len(path) - 2))
        last = int(rng.integers(first + 2, len(path)))
        if is_free(path[first], path[last]):
            del path[first + 1 : last]
    return path
