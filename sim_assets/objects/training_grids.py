"""Occupancy grids that the shape prior is trained and evaluated on.

Some of the training cans and bottles have a side of free form (free_forms.py): the families' cans are
straight, and a prior trained on these alone has no code for any other can.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8

from perception.types import Category
from sim_assets.objects.families import Parameters, Split, make_solid, sample_parameters
from sim_assets.objects.free_forms import free_form
from sim_assets.objects.grids import solid_counts

FREE: Mapping[Category, float] = {"can": 0.6, "bottle": 0.4}  # share of the training shapes of free form


def sample_training_shape(category: Category, split: Split, rng: np.random.Generator) -> Parameters:
    """Sample a shape of a split; of the training split, the shares FREE of the classes have a free form."""
    parameters = sample_parameters(category, split, rng)
    if split == "train" and category in FREE and rng.random() < FREE[category]:
        return free_form(parameters, rng)
    return parameters


def sample_training_grids(
    category: Category,
    count: int,
    seed: int | np.random.SeedSequence,
    split: Split = "train",
    first: int = 0,
) -> UInt8[np.ndarray, "n 32 32 32"]:
    """Return ``count`` random grids of a category, occupancy 0..1 as 0..255; a few ms each on one core.

    Args:
        category: Class of the shapes.
        count: Number of grids.
        seed: Seed of the sequence of shapes.
        split: Families of the shapes.
        first: Position of the first grid in the sequence; those before it cost less than 0.1 ms each.
    """
    rng = np.random.default_rng(seed)
    for _ in range(first):
        sample_training_shape(category, split, rng)
    grids = np.empty((count, 32, 32, 32), dtype=np.uint8)
    to_byte = np.round(np.arange(65) * 255 / 64).astype(np.uint8)
    for grid in grids:
        grid[:] = to_byte[solid_counts(make_solid(sample_training_shape(category, split, rng)))]
    return grids
