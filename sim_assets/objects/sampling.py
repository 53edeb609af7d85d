"""Sampling of a task's objects: a number of each class from the families of a split."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from perception.types import CATEGORIES, Category
from sim_assets.objects import ObjectModel, Split, sample_object

NESTING_STEP = 0.012  # smallest difference between the radii of nestable bowls [m]
_TRIES = 60


def draw_objects(
    counts: Mapping[Category, int], split: Split, rng: np.random.Generator
) -> tuple[ObjectModel, ...]:
    """Sample the objects of a task in random order.

    Several bowls are sampled by ``nestable``, as a set that can be nested.
    """
    drawn: list[ObjectModel] = []
    for category in CATEGORIES:
        count = counts.get(category, 0)
        if category == "bowl" and count > 1:
            drawn += nestable(lambda: sample_object("bowl", split, rng), count)
        else:
            drawn += [sample_object(category, split, rng) for _ in range(count)]
    return tuple(drawn[i] for i in rng.permutation(len(drawn)))


def nestable(draw: Callable[[], ObjectModel], count: int) -> list[ObjectModel]:
    """Sample ``count`` bowls whose radii differ by at least NESTING_STEP, by rejection.

    After _TRIES rejections the candidate whose radius differs most is taken.
    """
    bowls: list[ObjectModel] = []

    def step(bowl: ObjectModel) -> float:
        return min((abs(bowl.radius - other.radius) for other in bowls), default=np.inf)

    for _ in range(count):
        best = draw()
        for _ in range(_TRIES):
            if step(best) >= NESTING_STEP:
                break
            best = max(best, draw(), key=step)
        bowls.append(best)
    return bowls
