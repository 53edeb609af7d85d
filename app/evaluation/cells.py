"""Cells of a comparison of tasks: sources of shapes, numbers of images, and use of uncertainty."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields, replace
from typing import Any

from app.errors import UsageError
from app.options import EpisodeOptions, EvaluateOptions, Shapes, Switch, TaskOptions
from app.task.scene_options import view_counts


@dataclass(frozen=True)
class Cell:
    """What all episodes of a cell have in common.

    Attributes:
        shapes: Source of the object shapes.
        scan_views: Number of images of the scan.
        uncertainty: Whether standard deviations are used.
    """

    shapes: Shapes
    scan_views: int
    uncertainty: Switch

    @property
    def name(self) -> str:
        """Name, unique among cells."""
        views = f"{self.scan_views} view" + ("s" if self.scan_views > 1 else "")
        return f"{self.shapes}, {views}" + (", uncertainty off" if self.uncertainty == "off" else "")

    def key(self, seed: int) -> str:
        """Return the key of an episode, unique among all episodes of a comparison."""
        return f"{self.name}: {seed}"

    def of(self, options: EvaluateOptions) -> EvaluateOptions:
        """Return the options of this cell alone."""
        return replace(
            options,
            shapes=(self.shapes,),
            scan_views=str(self.scan_views),
            uncertainty=(self.uncertainty,),
        )


def cells_of(options: EvaluateOptions) -> tuple[Cell, ...]:
    """Return the cells that an evaluation of tasks compares; mostly one.

    The oracle needs no images to know shapes, and TSDF fusion no deviations: of cells that differ in what has
    no effect on them, one remains.

    Raises:
        UsageError: A value is given twice.
    """
    for name in ("shapes", "uncertainty"):
        values = getattr(options, name)
        if not values or len(set(values)) < len(values):
            raise UsageError(f"--{name} {' '.join(values)} takes different values, at least one")
    views = view_counts(options.scan_views)
    cells = [Cell(*values) for values in itertools.product(options.shapes, views, options.uncertainty)]
    exact = ("tsdf", "oracle")
    kept = [c for c in cells if c.shapes not in exact or c.uncertainty == options.uncertainty[0]]
    return tuple(c for c in kept if c.shapes != "oracle" or c.scan_views == max(views))


def episode_options(options: EvaluateOptions, seed: int) -> TaskOptions:
    """Return the options of one episode of an evaluation with a single cell."""
    (cell,) = cells_of(options)
    common: dict[str, Any] = {field.name: getattr(options, field.name) for field in fields(EpisodeOptions)}
    common["seed"] = seed
    return TaskOptions(**common, shapes=cell.shapes, scan_views=cell.scan_views, uncertainty=cell.uncertainty)
