"""Which objects a task is given: so many of each class, drawn from the families of a split."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from perception.types import CATEGORIES, Category
from sim_assets.errors import SimAssetsError
from sim_assets.objects import ObjectModel, Split, sample_object

NESTING_STEP = 0.012  # [m] by which the radii of bowls that are to nest should differ
_TRIES = 60


class RequestError(SimAssetsError, ValueError):
    """Objects were asked for that cannot be drawn."""


def class_counts(request: int | Mapping[Category, int], rng: np.random.Generator) -> dict[Category, int]:
    """How many objects of each class: as evenly as possible, the remainder going to classes at random.

    Raises:
        RequestError: for an unknown class, a negative count, or nothing at all.
    """
    if isinstance(request, int):
        each, remainder = divmod(request, len(CATEGORIES))
        lucky = set(rng.permutation(len(CATEGORIES))[:remainder].tolist())
        counts: dict[Category, int] = {c: each + (i in lucky) for i, c in enumerate(CATEGORIES)}
    else:
        unknown = [name for name in request if name not in CATEGORIES]
        if unknown:
            raise RequestError(f"class '{unknown[0]}' is none of {', '.join(CATEGORIES)}")
        counts = {c: int(request.get(c, 0)) for c in CATEGORIES}
    if min(counts.values()) < 0 or sum(counts.values()) < 1:
        raise RequestError(
            f"asked for {request}: counts must not be negative, and at least one object is needed"
        )
    return counts


def draw_objects(
    request: int | Mapping[Category, int], split: Split, rng: np.random.Generator
) -> tuple[ObjectModel, ...]:
    """Draw the objects of a task.

    Several bowls are drawn as a set that can be nested, the largest lowest: neighbours in size differ by
    NESTING_STEP in radius, or by as much as was found in some tries. The order is random.

    Args:
        request: a number, spread over the classes, or the number for each class.

    Raises:
        RequestError: the request cannot be met.
    """
    counts = class_counts(request, rng)
    drawn: list[ObjectModel] = []
    for category, count in counts.items():
        if category == "bowl" and count > 1:
            drawn += nestable(lambda: sample_object("bowl", split, rng), count)
        else:
            drawn += [sample_object(category, split, rng) for _ in range(count)]
    return tuple(drawn[i] for i in rng.permutation(len(drawn)))


def nestable(draw: Callable[[], ObjectModel], count: int) -> list[ObjectModel]:
    """``count`` bowls whose radii differ by NESTING_STEP; a bowl too like one that is there is drawn again.

    After enough tries the bowl that differs most is taken.
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
