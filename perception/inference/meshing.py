"""Watertight meshes from occupancy grids: marching cubes where the grid is half of what it is nearby.

A plain level of 0.5 loses what is thinner than a voxel: handles and rims decode to ridges that stay below
it. The surface is taken where the occupancy falls to half of its local maximum, so that a ridge keeps a
body as wide as its blur, and solid walls keep their level of 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float
from scipy import ndimage
from scipy.spatial import KDTree
from skimage import measure

from perception.errors import PerceptionError
from perception.inference.shape_model import Decoder, decode
from perception.types import Category, TriangleMesh

_OFF_THE_TIES = 1.7e-5  # a voxel exactly at the level would pinch the surface to a point there


class EmptyShapeError(PerceptionError):
    """A grid holds no surface at the level asked for."""


@dataclass(frozen=True)
class MeshConfig:
    """How surfaces are taken from grids.

    Attributes:
        iso: level of the normalised grid.
        ridge: smallest local maximum that still makes a surface; weaker structure is noise.
        solid: largest local maximum that is divided by: a weak handle must not lose its end at a solid body.
        reach: radius, in voxels, in which the local maximum is looked for.
    """

    iso: float = 0.5
    ridge: float = 0.3
    solid: float = 0.9
    reach: int = 1


def mesh_from_code(
    decoder: Decoder,
    category: Category,
    code: Float[np.ndarray, "16"],
    scale: Float[np.ndarray, "3"],
    config: MeshConfig | None = None,
) -> TriangleMesh:
    """Decodes a code and meshes it: object frame, [m], watertight."""
    return mesh_from_grid(decode(decoder, category, code), scale, category, config)


def mesh_from_grid(
    grid: Float[np.ndarray, "r r r"],
    scale: Float[np.ndarray, "3"],
    category: Category,
    config: MeshConfig | None = None,
) -> TriangleMesh:
    """Meshes a grid: object frame, [m], watertight, wound outwards; EmptyShapeError if nothing is in it."""
    config = config or MeshConfig()
    field = sharpen(np.asarray(grid, dtype=np.float32), config)
    padded = np.pad(field, 2)
    if padded.max() <= config.iso:
        raise EmptyShapeError(f"the decoded {category} has no voxel over {config.ridge}: nothing to mesh")
    level = config.iso + _OFF_THE_TIES
    points, faces, _, _ = measure.marching_cubes(padded, level=level, gradient_direction="ascent")
    canonical = -1 + (2 * (points - 2) + 1) / grid.shape[0]
    mesh = trimesh.Trimesh(canonical * scale, faces[:, ::-1], process=False)
    parts = mesh.split(only_watertight=True)
    if not len(parts):
        raise EmptyShapeError(f"the decoded {category} has no closed surface")
    body = max(parts, key=lambda part: abs(part.volume))
    kept = [body]
    if category == "mug":  # a handle that is cut off by a faint voxel or two still belongs to it
        kept += [
            part for part in parts if part is not body and _is_attached(part, body, 4 * scale.max() / 32)
        ]
    vertices = np.concatenate([part.vertices for part in kept])
    starts = np.cumsum([0] + [len(part.vertices) for part in kept[:-1]])
    indices = np.concatenate([part.faces + start for part, start in zip(kept, starts)])
    return TriangleMesh(vertices, indices if body.volume > 0 else indices[:, ::-1])


def _is_attached(part: trimesh.Trimesh, body: trimesh.Trimesh, distance: float) -> bool:
    """Whether a piece of some size outside the body comes near it."""
    if part.volume * body.volume < 0 or abs(part.volume) < 0.005 * abs(body.volume):
        return False  # a cavity, or a crumb
    nearest, _ = KDTree(body.vertices).query(part.vertices)
    return bool(nearest.min() < distance)


def sharpen(grid: Float[np.ndarray, "r r r"], config: MeshConfig) -> Float[np.ndarray, "r r r"]:
    """The grid over its local maximum, where that is a ridge at all."""
    local = ndimage.maximum_filter(grid, size=2 * config.reach + 1)
    return grid / np.clip(local, 2 * config.ridge * config.iso, config.solid)
