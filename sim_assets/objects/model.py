"""ObjectModel: mesh, collision pieces and mass of one object, for simulation and scoring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from perception.types import Category
from sim_assets.objects.bottle import BottleParameters
from sim_assets.objects.bowl import BowlParameters, bowl_vessel
from sim_assets.objects.can import CanParameters
from sim_assets.objects.convex.analytic import handle_pieces, stacked_pieces, vessel_pieces
from sim_assets.objects.convex.pieces import CollisionPiece
from sim_assets.objects.families import Parameters, Split, make_solid, sample_parameters
from sim_assets.objects.grids import canonical_frame, sampled_grid, solid_grid
from sim_assets.objects.mug import MugParameters, mug_vessel
from sim_assets.objects.solids import Solid

LIGHTEST, HEAVIEST = 0.05, 0.6  # range of masses that the gripper can carry [kg]


@runtime_checkable
class Shape(Protocol):
    """Geometry of a model; implemented by solids and by mesh files."""

    @property
    def bounds(self) -> Float[np.ndarray, "2 3"]: ...

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]: ...

    def is_handle(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]: ...


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One object in its own frame: z up, base on z = 0, axis x = y = 0, handle along +x; [m], [kg].

    Attributes:
        category: class of the object.
        split: split of its family, or "user" for a mesh file.
        name: name of the object, not necessarily unique.
        mesh: watertight surface, cavity included [m].
        collision: convex collision pieces.
        mass: mass [kg].
        parameters: parameters of the family; None for a mesh file.
        shape: geometry for inside tests.
    """

    category: Category
    split: Literal["train", "test", "user"]
    name: str
    mesh: trimesh.Trimesh
    collision: tuple[CollisionPiece, ...]
    mass: float
    parameters: Parameters | None
    shape: Shape

    def inside(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which points of the object frame are inside the material."""
        return self.shape.inside(np.asarray(points, dtype=np.float64))

    def is_handle(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
        """Return which surface points belong to a mug's handle."""
        return self.shape.is_handle(np.asarray(points, dtype=np.float64))

    @property
    def height(self) -> float:
        """Extent along z [m]."""
        return float(np.ptp(self.shape.bounds[:, 2]))

    @property
    def radius(self) -> float:
        """Half the extent along y [m], which excludes the handle of a mug."""
        return float(np.ptp(self.shape.bounds[:, 1]) / 2)


def make_object(parameters: Parameters, split: Split, name: str = "") -> ObjectModel:
    """Build the model of an object from the parameters of its family."""
    solid = make_solid(parameters)
    mesh = solid.mesh()
    category = category_of(parameters)
    mass = float(np.clip(mesh.volume * parameters.density, LIGHTEST, HEAVIEST))
    pieces = tuple(collision_pieces(parameters, solid))
    return ObjectModel(category, split, name or category, mesh, pieces, mass, parameters, solid)


def sample_object(category: Category, split: Split, rng: np.random.Generator) -> ObjectModel:
    """Sample an object of a category from the families of a split."""
    return make_object(sample_parameters(category, split, rng), split)


def category_of(parameters: Parameters) -> Category:
    match parameters:
        case MugParameters():
            return "mug"
        case BowlParameters():
            return "bowl"
        case BottleParameters():
            return "bottle"
        case CanParameters():
            return "can"


def collision_pieces(parameters: Parameters, solid: Solid) -> list[CollisionPiece]:
    """Return the convex pieces of an object of the families."""
    if isinstance(parameters, MugParameters):
        vessel = mug_vessel(parameters)
        assert solid.handle is not None
        return vessel_pieces(vessel, around=16, levels=4) + handle_pieces(solid.handle, vessel)
    if isinstance(parameters, BowlParameters):
        section = solid.body.section
        return vessel_pieces(bowl_vessel(parameters), 24 if section is None else 32, 5, section)
    beaded = isinstance(parameters, CanParameters) and parameters.kind == "beaded"
    return stacked_pieces(solid.body.profile, solid.body.section, most=40 if beaded else 9)


def occupancy_grid(
    model: ObjectModel, resolution: int = 32, supersample: int = 4
) -> Float[np.ndarray, "r r r"]:
    """Return the occupancy grid in [0, 1], float32; conventions in grids.py."""
    if isinstance(model.shape, Solid):
        return solid_grid(model.shape, resolution, supersample)
    return sampled_grid(model.shape.inside, model.shape.bounds, resolution, supersample)


def canonical_scale(model: ObjectModel) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return (scale, centre) of the model's grid: p_object = centre + scale * p_canonical."""
    return canonical_frame(model.shape.bounds)
