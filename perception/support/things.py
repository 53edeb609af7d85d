"""Things on a surface: samples above it that are connected in plan view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Int

from perception.support.extent import Extent
from perception.support.plan_grid import values_at
from perception.support.samples import Samples


@dataclass(frozen=True)
class ThingConfig:
    """Which connected samples above a surface are things that stand on it; lengths in metres.

    Attributes:
        margin: Distance beyond the extent up to which things belong to the surface.
        min_height: Height from which samples are things, at least the noise of the samples.
        max_base: Largest height of the lowest samples of a thing that stands on the surface.
        max_height: Largest height of a thing.
        max_distance: Largest depth of a thing.
        min_samples: Smallest number of samples of a thing.
        max_vessel: Largest extent of the bottom of a vessel.
        max_wall: Largest distance of a vessel's wall from its bottom in plan view.
        min_wall_share: Smallest share of the directions in which a vessel's wall was seen.
    """

    margin: float = 0.02
    min_height: float = 0.01
    max_base: float = 0.03
    max_height: float = 0.40
    max_distance: float = 2.0
    min_samples: int = 8
    max_vessel: float = 0.3
    max_wall: float = 0.06
    min_wall_share: float = 0.6


def things_on(
    samples: Samples,
    extent: Extent,
    explained: Bool[np.ndarray, "n"],
    config: ThingConfig = ThingConfig(),
) -> tuple[Int[np.ndarray, "n"], int]:
    """Return the index of the thing that each sample belongs to, -1 for none, and the number of things.

    A thing touches the surface, ends below the largest height, and lies mostly in the extent.

    Args:
        samples: Samples of all frames.
        extent: The surface.
        explained: Samples that are no things but show another surface.
        config: Parameters.
    """
    height, noise, cells = extent.height, extent.noise, extent.cells
    steps = round(config.margin / extent.grid.cell)
    wide = cv2.dilate(extent.inside, np.ones((3, 3), np.uint8), iterations=steps)
    raised = samples.valid & ~explained & (height > np.maximum(config.min_height, noise))
    raised &= values_at(np.asarray(wide), cells) > 0
    image = extent.grid.image(cells[raised])
    count, parts = cv2.connectedComponents(image, connectivity=8)
    label = np.where(raised, values_at(np.asarray(parts), cells), 0)

    def share(chosen: np.ndarray) -> np.ndarray:
        return np.bincount(label[raised & chosen], minlength=count) / np.maximum(seen, 1)

    seen = np.bincount(label, minlength=count)
    good = seen >= config.min_samples
    good &= share(height < config.max_base + noise) > 0.02
    good &= share(height > config.max_height) < 0.05
    good &= share(samples.depth > config.max_distance) < 0.5
    good &= share(values_at(extent.inside, cells) > 0) > 0.5
    good[0] = False  # cells without a thing
    return np.where(good, np.cumsum(good) - 1, -1)[label], int(good.sum())


def is_vessel_bottom(samples: Samples, extent: Extent, config: ThingConfig = ThingConfig()) -> bool:
    """Return whether a surface is the bottom of a bowl or pan: small, and its wall rises around it."""
    columns, rows = np.ptp(extent.hull, axis=0) + 1
    if max(columns, rows) * extent.grid.cell > config.max_vessel:
        return False
    reach = round(config.max_wall / extent.grid.cell)
    around = np.asarray(cv2.dilate(extent.inside, np.ones((2 * reach + 1,) * 2, np.uint8))) - extent.inside
    raised = samples.valid & (extent.height > np.maximum(config.min_height, extent.noise))
    row, column = np.nonzero((extent.grid.image(extent.cells[raised]) > 0) & (around > 0))
    middle = extent.hull.mean(0)
    sector = np.arctan2(row - middle[1], column - middle[0]) // (np.pi / 8)
    return len(np.unique(sector)) > 16 * config.min_wall_share
