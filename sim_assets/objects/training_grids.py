"""Occupancy grids that the shape prior is trained and evaluated on.

Some of the training shapes have the proportions met in homes (household.py), from flat tins to tubes, and
some cans and bottles a side of free form (free_forms.py): the families' cans are straight and of usual
proportions, and a prior trained on these alone has no code for any other can.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8

from perception.types import Category
from sim_assets.objects.families import Parameters, Split, make_solid, sample_parameters
from sim_assets.objects.free_forms import free_form
from sim_assets.objects.grids import solid_counts
from sim_assets.objects.household import sample_household

# Shares of the training shapes.
HOUSEHOLD: Mapping[Category, float] = {"mug": 0.0, "bowl": 0.4, "bottle": 0.4, "can": 0.5}
FREE: Mapping[Category, float] = {"mug": 0.0, "bowl": 0.0, "bottle": 0.4, "can": 0.6}


def sample_training_shape(category: Category, split: Split, rng: np.random.Generator) -> Parameters:
    """Sample a shape of a split; of the training split, some have proportions of homes or a free form."""
    if split == "test":
        return sample_parameters(category, split, rng)
    sample = sample_household if rng.random() < HOUSEHOLD[category] else sample_parameters
    parameters = sample(category, split, rng)
    return free_form(parameters, rng) if rng.random() < FREE[category] else parameters


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
