"""Watertight meshes from occupancy grids: marching cubes, with walls and handles thinner than a voxel.

The level set of 0.5 loses structures thinner than a voxel: handles and rims decode to ridges below it. Two
level sets are extracted instead. The sharp surface lies where the occupancy falls to half of its local
maximum: its walls have the right thickness, but holes where a wall passes midway between two voxels and the
occupancy is halved. The whole surface lies where the occupancy falls to a share of the mean height of the
ridge around: without such holes, but too thick. It is offset inwards by a constant distance until it encloses
the volume of the sharp surface. On solid parts both surfaces coincide.
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
from perception.inference.shape_model import Decoder
from perception.surface_geometry import surface_area, vertex_normals
from perception.types import Category, TriangleMesh

_SOLID_THICKNESS = 5  # [voxel] smallest thickness of solid parts, which have no ridge
_LEVEL_OFFSET = 1.7e-5  # avoids voxels exactly at the level, where the surface would be non-manifold


class EmptyShapeError(PerceptionError):
    """A grid has no surface at the requested level."""


@dataclass(frozen=True)
class MeshConfig:
    """Settings of the surface extraction.

    Attributes:
        iso: Level of the normalised grid.
        ridge: Smallest local maximum that has a surface; weaker structures are noise.
        solid: Largest divisor, so that the end of a weak handle next to a solid body is kept.
        reach: Radius of the local maximum, in voxels.
        crest: Divisor of the whole surface as a share of the mean height of the ridge.
        spread: Standard deviation of the Gaussian window of that mean, in voxels.
        inset: Largest inward offset of the whole surface, in voxels.
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
    config: MeshConfig = MeshConfig(),
) -> TriangleMesh:
    """Decode a code and return its watertight mesh in the object frame, in metres."""
    return mesh_from_grid(decoder(category, code), scale, category, config)


def mesh_from_grid(
    grid: Float[np.ndarray, "r r r"],
    scale: Float[np.ndarray, "3"],
    category: Category,
    config: MeshConfig = MeshConfig(),
) -> TriangleMesh:
    """Return the watertight mesh of a grid in the object frame, in metres, with outward normals.

    Raises:
        EmptyShapeError: The grid has no surface.
    """
    grid = np.asarray(grid, dtype=np.float32)
    _, sharp_volume = _surface(sharpen(grid, config), scale, category, config)
    whole, volume = _surface(grid / _divisor(grid, config), scale, category, config)
    farthest = config.inset * 2 * float(scale.max()) / grid.shape[0]
    inset = float(np.clip((volume - sharp_volume) / surface_area(whole), 0.0, farthest))
    return TriangleMesh(whole.vertices - inset * vertex_normals(whole), whole.faces)


def _surface(
    field: Float[np.ndarray, "r r r"], scale: Float[np.ndarray, "3"], category: Category, config: MeshConfig
) -> tuple[TriangleMesh, float]:
    """Return the largest closed surface at the level with its cavities and handle, and its volume in m³."""
    padded = np.pad(field, 2)
    if padded.max() <= config.iso:
        raise EmptyShapeError(f"the decoded {category} has no voxel over {config.ridge}: nothing to mesh")
    level = config.iso + _LEVEL_OFFSET
    points, faces, _, _ = measure.marching_cubes(padded, level=level, gradient_direction="ascent")
    vertices, faces = (-1 + (2 * (points - 2) + 1) / field.shape[0]) * scale, faces[:, ::-1]
    part_of, volumes = _parts(vertices, faces)
    if not volumes.any():
        raise EmptyShapeError(f"the decoded {category} has no closed surface")
    body = int(np.abs(volumes).argmax())
    kept = {body}
    if category == "mug":  # the handle may be separated from the body by voxels of low occupancy
        share = volumes / volumes[body]  # negative for cavities, small for fragments
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
    """Return the connected part of each vertex, and the parts' signed volumes in m³, 0 where not closed."""
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
    """Return the grid divided by its local maximum, clipped to the range from ridges to solid parts."""
    local = ndimage.maximum_filter(grid, size=2 * config.reach + 1)
    return grid / np.clip(local, 2 * config.ridge * config.iso, config.solid)


def _divisor(grid: Float[np.ndarray, "r r r"], config: MeshConfig) -> Float[np.ndarray, "r r r"]:
    """Return the divisor of the occupancy for the whole surface: a share of the mean height of nearby ridges.

    A ridge consists of the local maxima along any axis. Unlike their maximum, their mean does not depend on
    the position of a wall between the voxels.
    """
    padded = np.pad(grid, 1)
    high = padded > 0.5 * config.ridge
    ridge = padded > config.solid
    for axis in range(3):
        before, after = np.roll(padded, 1, axis), np.roll(padded, -1, axis)
        bent = 2 * padded - before - after > 0.05 * padded  # excludes plateaus of noise
        ridge |= (padded >= before) & (padded >= after) & bent & high
    amount, weight = (
        ndimage.gaussian_filter(values.astype(np.float32), config.spread, truncate=3.0)
        for values in (padded * ridge, ridge)
    )
    mean = np.divide(amount, weight, out=np.ones_like(amount), where=weight > 1e-4)[1:-1, 1:-1, 1:-1]
    thin = np.clip(config.crest * mean, 2 * config.ridge * config.iso, config.solid)
    solid = ndimage.maximum_filter(ndimage.grey_opening(grid, size=_SOLID_THICKNESS), size=_SOLID_THICKNESS)
    return np.maximum(thin, np.minimum(solid, config.solid))
