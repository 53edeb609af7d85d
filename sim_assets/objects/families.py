"""The four object families: parameters, solids and occupancy grids."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from perception.types import Category
from sim_assets.objects.bottle import BottleParameters, bottle_solid, sample_bottle
from sim_assets.objects.bowl import BowlParameters, bowl_solid, sample_bowl
from sim_assets.objects.can import CanParameters, can_solid, sample_can
from sim_assets.objects.grids import solid_grid
from sim_assets.objects.mug import MugParameters, mug_solid, sample_mug
from sim_assets.objects.solids import Solid

Split = Literal["train", "test"]
SPLITS: tuple[Split, ...] = ("train", "test")
Parameters = MugParameters | BowlParameters | BottleParameters | CanParameters

_SAMPLERS = {"mug": sample_mug, "bowl": sample_bowl, "bottle": sample_bottle, "can": sample_can}


def sample_parameters(category: Category, split: Split, rng: np.random.Generator) -> Parameters:
    """Sample the parameters of an object of a category from the families of a split."""
    return _SAMPLERS[category](split, rng)


def make_solid(parameters: Parameters) -> Solid:
    """Return the solid described by the parameters."""
    match parameters:
        case MugParameters():
            return mug_solid(parameters)
        case BowlParameters():
            return bowl_solid(parameters)
        case BottleParameters():
            return bottle_solid(parameters)
        case CanParameters():
            return can_solid(parameters)


def occupancy_grid_of(
    parameters: Parameters, resolution: int = 32, supersample: int = 4
) -> Float[np.ndarray, "r r r"]:
    """Return the occupancy grid in [0, 1] of an object; conventions in grids.py."""
    return solid_grid(make_solid(parameters), resolution, supersample)
