"""Occupancy grids of solids, without building meshes: 2-8 ms each.

Convention: 32³ voxels over the canonical cube [-1, 1]³, voxel i centred at -1 + (2 i + 1) / 32, index order
[ix, iy, iz]. The bounding box is centred at the origin, its longest side 1.8. A voxel's value is the share of
its supersamples (4³) inside the solid.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from sim_assets.objects.profiles import radial_crossings
from sim_assets.objects.solids import Solid

LONGEST_SIDE = 1.8


def canonical_frame(bounds: Float[np.ndarray, "2 3"]) -> tuple[float, Float[np.ndarray, "3"]]:
    """Return (scale, centre) of a bounding box, with p_object = centre + scale * p_canonical."""
    return float((bounds[1] - bounds[0]).max() / LONGEST_SIDE), 0.5 * (bounds[0] + bounds[1])


def axis_samples(count: int) -> Float[np.ndarray, "n"]:
    """Return the centres of `count` equal cells over [-1, 1]."""
    return (2.0 * np.arange(count) + 1.0) / count - 1.0


def solid_counts(solid: Solid, resolution: int = 32, supersample: int = 4) -> UInt8[np.ndarray, "r r r"]:
    """Count each voxel's supersamples inside the solid, which is symmetric about y = 0."""
    scale, centre = canonical_frame(solid.bounds)
    at = axis_samples(resolution * supersample) * scale
    x, z = centre[0] + at, centre[2] + at
    y = at[len(at) // 2 :]
    inside = _inside_body(solid, x, y, z)  # (z, y, x), y > 0
    if solid.handle is not None:
        _add_handle(inside, solid, x, y, z)
    counts = inside.view(np.uint8)
    for axis in range(3):  # slowest axis first: the sums run over contiguous memory
        shape = (*counts.shape[:axis], -1, supersample, *counts.shape[axis + 1 :])
        parts = np.moveaxis(counts.reshape(shape), axis + 1, 0)
        total = parts[0] + parts[1]
        for part in parts[2:]:
            total += part
        counts = total
    return np.concatenate([counts[:, ::-1], counts], axis=1).transpose(2, 1, 0)


def solid_grid(solid: Solid, resolution: int = 32, supersample: int = 4) -> Float[np.ndarray, "r r r"]:
    """Return the occupancy in [0, 1], float32."""
    return solid_counts(solid, resolution, supersample).astype(np.float32) / supersample**3


def _inside_body(solid: Solid, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the (z, y, x) inside mask: parity of the crossings beyond each sample's radius."""
    r = np.hypot(x, y[:, None]).astype(np.float32)
    crossings = radial_crossings(solid.body.profile, z).astype(np.float32)[:, :, None, None]
    inside = np.zeros((len(z), len(y), len(x)), dtype=bool)
    rows = np.flatnonzero(crossings[:, :1].any(axis=(1, 2, 3)))
    if not len(rows):
        return inside
    rows = slice(rows[0], rows[-1] + 1)  # one block: views instead of copies
    block, crossings = inside[rows], crossings[rows].transpose(1, 0, 2, 3)
    section = solid.body.section
    if section is None:
        for crossing in crossings:
            block ^= r < crossing
        return inside
    modulation = section.modulation(x / r, y[:, None] / r).astype(np.float32)
    weight = section.weight(z[rows]).astype(np.float32)[:, None, None]
    for crossing in crossings:  # r / (1 + weight * modulation) < crossing, without dividing volumes
        block ^= r < crossing + (crossing * weight) * modulation
    return inside


def _add_handle(inside: np.ndarray, solid: Solid, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> None:
    """Mark, in place, the samples of the handle outside the body's core."""
    assert solid.handle is not None
    low, high = solid.handle.outline.min(axis=0), solid.handle.outline.max(axis=0)
    columns = np.flatnonzero((x > low[0]) & (x < high[0]))
    rows = np.flatnonzero((z > low[1]) & (z < high[1]))
    if not len(columns) or not len(rows):
        return
    columns, rows = slice(columns[0], columns[-1] + 1), slice(rows[0], rows[-1] + 1)
    grid_x, grid_z = np.meshgrid(x[columns], z[rows])
    half_width = solid.handle.half_width(grid_x.ravel(), grid_z.ravel()).reshape(grid_x.shape)
    reach = int(np.searchsorted(y, half_width.max()))
    r2 = x[columns] ** 2 + y[:reach, None] ** 2
    core2 = solid.core_radius(z[rows]) ** 2
    block = inside[rows, :reach, columns]
    block |= (y[None, :reach, None] < half_width[:, None]) & (r2 > core2[:, None, None])


def sampled_grid(
    inside: Callable[[Float[np.ndarray, "n 3"]], Bool[np.ndarray, "n"]],
    bounds: Float[np.ndarray, "2 3"],
    resolution: int = 32,
    supersample: int = 4,
) -> Float[np.ndarray, "r r r"]:
    """Compute the same grid from any inside test, slab by slab."""
    scale, centre = canonical_frame(bounds)
    at = axis_samples(resolution * supersample)
    y, z = np.meshgrid(at, at, indexing="ij")
    grid = np.zeros((resolution,) * 3, dtype=np.float32)
    for i, x in enumerate(at):
        slab = np.stack([np.full(y.size, x), y.ravel(), z.ravel()], axis=1)
        hits = inside(centre + scale * slab).reshape(resolution, supersample, resolution, supersample)
        grid[i // supersample] += hits.sum(axis=(1, 3), dtype=np.float32)
    return grid / supersample**3
