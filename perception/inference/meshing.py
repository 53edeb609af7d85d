"""Watertight meshes from occupancy grids: marching cubes where the grid is half of what it is nearby.

A plain level of 0.5 loses what is thinner than a voxel: handles and rims decode to ridges that stay below
it. The surface is taken where the occupancy falls to half of its local maximum, so that a ridge keeps a
body as wide as its blur, and solid walls keep their level of 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph
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
    vertices, faces = (-1 + (2 * (points - 2) + 1) / grid.shape[0]) * scale, faces[:, ::-1]
    part_of, volumes = _parts(vertices, faces)
    if not volumes.any():
        raise EmptyShapeError(f"the decoded {category} has no closed surface")
    body = int(np.abs(volumes).argmax())
    kept = {body}
    if category == "mug":  # a handle that is cut off by a faint voxel or two still belongs to it
        share = volumes / volumes[body]  # a cavity's is negative, a crumb's next to nothing
        near = KDTree(vertices[part_of == body])
        for part in np.flatnonzero(share >= 0.005):
            if near.query(vertices[part_of == part])[0].min() < 4 * scale.max() / 32:
                kept.add(int(part))
    keep = np.isin(part_of, sorted(kept))
    faces = (np.cumsum(keep) - 1)[faces[keep[faces[:, 0]]]]
    return TriangleMesh(vertices[keep], faces if volumes[body] > 0 else faces[:, ::-1])


def _parts(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, "v"], Float[np.ndarray, "p"]]:
    """Each vertex's connected part, and the signed volumes of the parts; 0 for one that is not closed."""
    n = len(vertices)
    edges = np.sort(np.concatenate([faces[:, (0, 1)], faces[:, (1, 2)], faces[:, (2, 0)]]), axis=1)
    keys, uses = np.unique(edges[:, 0].astype(np.int64) * n + edges[:, 1], return_counts=True)
    graph = sparse.coo_array((np.ones(len(keys), bool), (keys // n, keys % n)), shape=(n, n))
    count, part_of = csgraph.connected_components(graph, directed=False)
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    sixfold = np.einsum("ij,ij->i", a, np.cross(b, c))
    volumes = np.bincount(part_of[faces[:, 0]], sixfold, minlength=count) / 6
    volumes[part_of[keys[uses != 2] // n]] = 0.0
    return part_of, volumes


def sharpen(grid: Float[np.ndarray, "r r r"], config: MeshConfig) -> Float[np.ndarray, "r r r"]:
    """The grid over its local maximum, where that is a ridge at all."""
    local = ndimage.maximum_filter(grid, size=2 * config.reach + 1)
    return grid / np.clip(local, 2 * config.ridge * config.iso, config.solid)
