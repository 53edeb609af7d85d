"""Object CAD families: mugs, bowls, bottles and cans, each from a frozen record of parameters in [m]."""

from sim_assets.objects.families import (
    SPLITS,
    Parameters,
    Split,
    make_solid,
    occupancy_grid_of,
    sample_parameters,
    sample_training_grids,
)

__all__ = [
    "SPLITS",
    "Parameters",
    "Split",
    "make_solid",
    "occupancy_grid_of",
    "sample_parameters",
    "sample_training_grids",
]
