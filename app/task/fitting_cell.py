"""A cell whose objects fit on the table and rest there: what does not is replaced, as little as possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from perception.types import Category
from sim_assets.cell.config import CellConfig
from sim_assets.cell.layout import ArrangementError, LayoutError, UnstableError
from sim_assets.cell.unknown import UnknownThing
from sim_assets.cell.world import World
from sim_assets.objects import ObjectModel

REDRAWS = 6  # of an object that leaves no room for the others
OTHER_OBJECTS = 2  # sets of objects that are drawn for the resting poses asked for
GAP_FACTOR = 0.5  # by which gaps shrink that nobody asked for, once no object can be smaller


@dataclass(frozen=True)
class Freedom:
    """What may be changed in a cell that cannot be laid out.

    Attributes:
        draw: draws another object of a class; None if the objects are given.
        draw_thing: draws another thing of no class.
        smaller_gap: whether the objects may stand closer together.
        fewer_poses: whether fewer objects may lie, stand on their rim or on others.
    """

    draw: Callable[[Category], ObjectModel] | None
    draw_thing: Callable[[], UnknownThing]
    smaller_gap: bool
    fewer_poses: bool


def fitting_world(config: CellConfig, freedom: Freedom) -> World:
    """Return the world of a configuration, or of a similar one that can be laid out.

    The configuration that was built is ``World.config``.

    Raises:
        LayoutError: no similar one was found either; the message is that of the first failure.
    """
    first: LayoutError | None = None
    n_attempts = 4 + 2 * len(config.objects)
    for attempt in range(n_attempts):
        try:
            return World(config)
        except LayoutError as error:
            first = first or error
            changed = _changed(config, freedom, error, attempt)
            if changed is None:
                break
            config = changed
    assert first is not None
    raise first


def _changed(config: CellConfig, freedom: Freedom, error: LayoutError, attempt: int) -> CellConfig | None:
    """Return the configuration with the cause of an error changed; None if nothing may be."""
    if isinstance(error, UnstableError):
        return _with_another_body(config, freedom, error.body)
    if isinstance(error, ArrangementError):
        if freedom.draw is not None and attempt < OTHER_OBJECTS:
            objects = tuple(freedom.draw(model.category) for model in config.objects)
            return replace(config, objects=objects)
        if not freedom.fewer_poses or config.arrangement.at_most:
            return None
        return replace(config, arrangement=replace(config.arrangement, at_most=True))
    smaller = None if freedom.draw is None else with_a_smaller_object(config.objects, freedom.draw)
    if smaller is not None and attempt < len(config.objects):
        return replace(config, objects=smaller)
    if freedom.smaller_gap and config.min_gap > 0.001:
        return replace(config, min_gap=GAP_FACTOR * config.min_gap)
    return None


def _with_another_body(config: CellConfig, freedom: Freedom, body: str) -> CellConfig | None:
    """Return the configuration with another object, or another thing of no class, in place of a body."""
    if body.startswith("unknown"):
        things = list(config.unknown)
        things[int(body.removeprefix("unknown"))] = freedom.draw_thing()
        return replace(config, unknown=tuple(things))
    if freedom.draw is None:
        return None
    objects, index = list(config.objects), int(body.removeprefix("object"))
    objects[index] = freedom.draw(objects[index].category)
    return replace(config, objects=tuple(objects))


def with_a_smaller_object(
    models: tuple[ObjectModel, ...], draw: Callable[[Category], ObjectModel]
) -> tuple[ObjectModel, ...] | None:
    """Return the objects with the widest one, or else the next, replaced by a narrower draw of its class.

    None if no draw of any class was narrower.
    """
    for index in sorted(range(len(models)), key=lambda i: width(models[i]), reverse=True):
        narrowest = min((draw(models[index].category) for _ in range(REDRAWS)), key=width)
        if width(narrowest) < width(models[index]):
            return (*models[:index], narrowest, *models[index + 1 :])
    return None


def width(model: ObjectModel) -> float:
    """Return the radius of the circle about the model's axis that holds all of it, in metres."""
    return float(np.linalg.norm(model.mesh.vertices[:, :2], axis=1).max())
