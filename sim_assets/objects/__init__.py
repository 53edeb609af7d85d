"""Object CAD families: mugs, bowls, bottles and cans, each generated from frozen parameters in [m]."""

from sim_assets.objects.families import (
    SPLITS,
    Parameters,
    Split,
    make_solid,
    occupancy_grid_of,
    sample_parameters,
)
from sim_assets.objects.model import (
    CollisionPiece,
    ObjectModel,
    canonical_scale,
    make_object,
    occupancy_grid,
    sample_object,
)
from sim_assets.objects.training_grids import sample_training_grids
from sim_assets.objects.user import load_user_object, load_user_objects

__all__ = [
    "SPLITS",
    "CollisionPiece",
    "ObjectModel",
    "Parameters",
    "Split",
    "canonical_scale",
    "load_user_object",
    "load_user_objects",
    "make_object",
    "make_solid",
    "occupancy_grid",
    "occupancy_grid_of",
    "sample_object",
    "sample_parameters",
    "sample_training_grids",
]
