"""How far a reconstructed surface may be off, from the covariance of its fit.

The surface is where the occupancy o(g, z) keeps its level. To first order a step of code, rotation,
translation and log scale (dz, omega, v, sigma) moves the point p of the object frame along its normal n by

    (do/dz . dz) / |grad_p o|  +  omega . (p x n)  +  v . (R n)  +  sigma . (p * n)

and the variance of that is a quadratic form in the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Float

from perception.types import GRID_RESOLUTION, Category, ObjectEstimate

LEAST_SLOPE = (
    0.1  # occupancy per voxel; a flatter one, of faint walls, would make any surface endlessly unsure
)


@dataclass(frozen=True)
class BandConfig:
    """Calibration of the bands, by class.

    Attributes:
        inflation: true errors where nothing was measured, over those the covariance predicts. Under 1: the
            fit takes one pixel in twenty for independent of the others, which is too few.
        floor: error that is left where the surface was measured, in [m].
    """

    inflation: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 0.425, "bowl": 0.51, "bottle": 0.88, "can": 0.47}
    )
    floor: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 6.0e-4, "bowl": 7.5e-4, "bottle": 4.3e-4, "can": 3.85e-4}
    )


def surface_band(
    estimate: ObjectEstimate,
    covariance: Float[np.ndarray, "25 25"],
    determined: Float[np.ndarray, "v"],
    grid: Float[np.ndarray, "r r r"],
    jacobian: Float[np.ndarray, "r r r 16"],
    config: BandConfig | None = None,
) -> Float[np.ndarray, "v"]:
    """Calibrated standard deviation along the normal of each vertex, in [m].

    ``determined`` says for each vertex to which share the measurements placed it (see ``refine.py``);
    ``grid`` and ``jacobian`` are what the estimate's code decodes to.
    """
    config = config or BandConfig()
    inflation, floor = config.inflation[estimate.category], config.floor[estimate.category]
    fitted = inflation * surface_deviation(estimate, covariance, grid, jacobian)
    return np.hypot(np.sqrt(1 - determined) * fitted, floor)


def surface_deviation(
    estimate: ObjectEstimate,
    covariance: Float[np.ndarray, "25 25"],
    grid: Float[np.ndarray, "r r r"],
    jacobian: Float[np.ndarray, "r r r 16"],
) -> Float[np.ndarray, "v"]:
    """One standard deviation along the normal of each vertex of the mesh, in [m].

    ``grid`` and ``jacobian`` are what the estimate's code decodes to.
    """
    points = estimate.mesh.vertices
    normals = trimesh.Trimesh(points, estimate.mesh.faces, process=False).vertex_normals
    voxel = 2 * estimate.scale / GRID_RESOLUTION  # [m]
    where = (points / estimate.scale + 1) / 2 * GRID_RESOLUTION - 0.5
    slopes = _at(np.stack([np.gradient(grid, axis=k) for k in range(3)], axis=-1), where) / voxel
    slope = np.maximum(np.linalg.norm(slopes, axis=1), LEAST_SLOPE / voxel.mean())
    by_code = _at(jacobian, where)
    rows = np.hstack([
        by_code / slope[:, None],
        np.cross(points, normals),
        normals @ estimate.T_world_object[:3, :3].T,
        points * normals,
    ])  # fmt: skip
    return np.sqrt(np.maximum(((rows @ covariance) * rows).sum(axis=1), 0.0))


def _at(values: Float[np.ndarray, "r r r c"], where: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v c"]:
    """Trilinear, at points in voxels, all channels at once; outside as at the border."""
    side = values.shape[0]
    where = np.clip(where, 0, side - 1 - 1e-6)
    low = where.astype(int)
    share = (where - low).astype(values.dtype)
    flat = values.reshape(-1, values.shape[-1])
    base = (low[:, 0] * side + low[:, 1]) * side + low[:, 2]
    result = np.zeros((len(where), values.shape[-1]), values.dtype)
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, share, 1 - share).prod(axis=1)
        result += weight[:, None] * flat[base + (corner[0] * side + corner[1]) * side + corner[2]]
    return result
