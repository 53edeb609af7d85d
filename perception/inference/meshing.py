"""Watertight meshes from occupancy grids: marching cubes, with walls and handles thinner than a voxel.

A plain level of 0.5 loses what is thinner than a voxel: handles and rims decode to ridges that stay below
it. Two surfaces are taken instead. The sharp one lies where the occupancy falls to half of its local maximum:
its walls are as thick as they should be, but have holes where a wall passes between two voxels, for there
it is at half of what it is next to it. The whole one lies where the occupancy falls to a share of the ridge's
mean height around: it has no such holes, but is too thick. It is moved inwards, everywhere by the same, until
it holds as much as the sharp one. Of what is massive both are the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree
from skimage import measure

from perception.errors import PerceptionError
from perception.inference.shape_model import Decoder, decode
from perception.types import Category, TriangleMesh

_MASSIVE = 5  # voxels of thickness from which on there is no ridge, and nothing to close
_OFF_THE_TIES = 1.7e-5  # a voxel exactly at the level would pinch the surface to a point there


class EmptyShapeError(PerceptionError):
    """A grid has no surface at the requested level."""


@dataclass(frozen=True)
class MeshConfig:
    """How surfaces are taken from grids.

    Attributes:
        iso: level of the normalised grid.
        ridge: smallest local maximum that still makes a surface; weaker structure is noise.
        solid: largest local maximum that is divided by: a weak handle must not lose its end at a solid body.
        reach: radius, in voxels, in which the local maximum is looked for.
        crest: share of a ridge's mean height that the whole surface divides by.
        spread: radius of that mean, one deviation, in voxels.
        inset: farthest that the whole surface is moved inwards, in voxels.
    """

    iso: float = 0.5
    ridge: float = 0.3
    solid: float = 0.9
    reach: int = 1
    crest: float = 0.65
    spread: float = 1.2
    inset: float = 0.45


def mesh_from_code(
    decoder: Decoder,
    category: Category,
    code: Float[np.ndarray, "16"],
    scale: Float[np.ndarray, "3"],
    config: MeshConfig | None = None,
) -> TriangleMesh:
    """Decode a code and return its watertight mesh in the object frame, in metres."""
    return mesh_from_grid(decode(decoder, category, code), scale, category, config)


def mesh_from_grid(
    grid: Float[np.ndarray, "r r r"],
    scale: Float[np.ndarray, "3"],
    category: Category,
    config: MeshConfig | None = None,
) -> TriangleMesh:
    """Return the watertight mesh of a grid in the object frame, in metres, with outward normals.

    Raises:
        EmptyShapeError: The grid has no surface.
    """
    config = config or MeshConfig()
    grid = np.asarray(grid, dtype=np.float32)
    _, sharp_volume = _surface(sharpen(grid, config), scale, category, config)
    whole, volume = _surface(grid / _divisor(grid, config), scale, category, config)
    surface = trimesh.Trimesh(whole.vertices, whole.faces, process=False)
    farthest = config.inset * 2 * float(scale.max()) / grid.shape[0]
    inset = float(np.clip((volume - sharp_volume) / surface.area, 0.0, farthest))
    return TriangleMesh(whole.vertices - inset * surface.vertex_normals, whole.faces)


def _surface(
    field: Float[np.ndarray, "r r r"], scale: Float[np.ndarray, "3"], category: Category, config: MeshConfig
) -> tuple[TriangleMesh, float]:
    """The largest closed surface at the level, in [m], with what belongs to it, and the volume in [m³]."""
    padded = np.pad(field, 2)
    if padded.max() <= config.iso:
        raise EmptyShapeError(f"the decoded {category} has no voxel over {config.ridge}: nothing to mesh")
    level = config.iso + _OFF_THE_TIES
    points, faces, _, _ = measure.marching_cubes(padded, level=level, gradient_direction="ascent")
    vertices, faces = (-1 + (2 * (points - 2) + 1) / field.shape[0]) * scale, faces[:, ::-1]
    part_of, volumes = _parts(vertices, faces)
    if not volumes.any():
        raise EmptyShapeError(f"the decoded {category} has no closed surface")
    body = int(np.abs(volumes).argmax())
    kept = {body}
    if category == "mug":  # a handle that is cut off by a faint voxel or two still belongs to it
        share = volumes / volumes[body]  # a cavity's is negative, a crumb's next to nothing
        for part in set(np.flatnonzero(share >= 0.005).tolist()) - kept:
            away = KDTree(vertices[part_of == body]).query(vertices[part_of == part])[0]
            if away.min() < 4 * scale.max() / 32:
                kept.add(part)
    keep = np.isin(part_of, sorted(kept))
    faces = (np.cumsum(keep) - 1)[faces[keep[faces[:, 0]]]]
    volume = float(np.abs(volumes[sorted(kept)].sum()))
    return TriangleMesh(vertices[keep], faces if volumes[body] > 0 else faces[:, ::-1]), volume


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
    """Divide the grid by its local maximum, where that is high enough to be a ridge."""
    local = ndimage.maximum_filter(grid, size=2 * config.reach + 1)
    return grid / np.clip(local, 2 * config.ridge * config.iso, config.solid)


def _divisor(grid: Float[np.ndarray, "r r r"], config: MeshConfig) -> Float[np.ndarray, "r r r"]:
    """What the occupancy is divided by for the whole surface: a share of how high ridges are around.

    The mean over a ridge's voxels, those between two lower ones along some axis, does not depend on where
    between the voxels a wall passes; the maximum does.
    """
    padded = np.pad(grid, 1)
    high = padded > 0.5 * config.ridge
    ridge = padded > config.solid
    for axis in range(3):
        before, after = np.roll(padded, 1, axis), np.roll(padded, -1, axis)
        bent = 2 * padded - before - after > 0.05 * padded  # a plateau of noise is no ridge
        ridge |= (padded >= before) & (padded >= after) & bent & high
    amount, weight = (
        ndimage.gaussian_filter(values.astype(np.float32), config.spread, truncate=3.0)
        for values in (padded * ridge, ridge)
    )
    mean = np.divide(amount, weight, out=np.ones_like(amount), where=weight > 1e-4)[1:-1, 1:-1, 1:-1]
    thin = np.clip(config.crest * mean, 2 * config.ridge * config.iso, config.solid)
    massive = ndimage.maximum_filter(ndimage.grey_opening(grid, size=_MASSIVE), size=_MASSIVE)
    return np.maximum(thin, np.minimum(massive, config.solid))
