"""Standard deviation of a reconstructed surface, from the covariance of its fit.

The surface is a level set of the occupancy o(g, z). To first order a step of code, rotation, translation and
log scale (dz, omega, v, sigma) moves the point p of the object frame along its normal n by

    (do/dz . dz) / |grad_p o|  +  omega . (p x n)  +  v . (R n)  +  sigma . (p * n),

whose variance is a quadratic form in the covariance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from perception.surface_geometry import vertex_normals
from perception.types import GRID_RESOLUTION, Category, ObjectEstimate

MIN_SLOPE = 0.1  # [1/voxel] smallest occupancy gradient; faint walls would have unbounded deviations


@dataclass(frozen=True)
class CalibrationConfig:
    """Calibration of the predicted deviations, by class.

    Attributes:
        inflation: Ratio of true to predicted deviations where nothing was measured. Below 1, because the
            data weight of the fit treats one pixel in twenty as independent, which is too few.
        floor: Standard deviation that remains where the surface was measured, in metres.
    """

    inflation: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 0.395, "bowl": 0.45, "bottle": 0.62, "can": 0.47}
    )
    floor: Mapping[Category, float] = field(
        default_factory=lambda: {"mug": 5.6e-4, "bowl": 6.6e-4, "bottle": 3.0e-4, "can": 3.85e-4}
    )


def calibrated_deviation(
    estimate: ObjectEstimate,
    covariance: Float[np.ndarray, "25 25"],
    determined: Float[np.ndarray, "v"],
    grid: Float[np.ndarray, "r r r"],
    jacobian: Float[np.ndarray, "r r r 16"],
    config: CalibrationConfig = CalibrationConfig(),
) -> Float[np.ndarray, "v"]:
    """Return the calibrated standard deviation along the normal of each vertex, in metres.

    Args:
        estimate: Fitted object.
        covariance: Covariance of code, rotation, translation and log scale.
        determined: For each vertex the fraction of its position that measurements determined (``refine.py``).
        grid: Occupancies decoded from the estimate's code.
        jacobian: Their derivative with respect to the code.
        config: Calibration.
    """
    inflation, floor = config.inflation[estimate.category], config.floor[estimate.category]
    fitted = inflation * surface_deviation(estimate, covariance, grid, jacobian)
    return np.hypot(np.sqrt(1 - determined) * fitted, floor)


def surface_deviation(
    estimate: ObjectEstimate,
    covariance: Float[np.ndarray, "25 25"],
    grid: Float[np.ndarray, "r r r"],
    jacobian: Float[np.ndarray, "r r r 16"],
) -> Float[np.ndarray, "v"]:
    """Return the standard deviation along the normal of each vertex that the covariance predicts, in metres.

    Arguments as for ``calibrated_deviation``.
    """
    points = estimate.mesh.vertices
    normals = vertex_normals(estimate.mesh)
    voxel = 2 * estimate.scale / GRID_RESOLUTION  # [m]
    where = (points / estimate.scale + 1) / 2 * GRID_RESOLUTION - 0.5
    gradients = _interpolated(np.stack([np.gradient(grid, axis=k) for k in range(3)], axis=-1), where) / voxel
    slope = np.maximum(np.linalg.norm(gradients, axis=1), MIN_SLOPE / voxel.mean())
    d_code = _interpolated(jacobian, where)
    rows = np.hstack([
        d_code / slope[:, None],
        np.cross(points, normals),
        normals @ estimate.T_world_object[:3, :3].T,
        points * normals,
    ])  # fmt: skip
    return np.sqrt(np.maximum(((rows @ covariance) * rows).sum(axis=1), 0.0))


def _interpolated(
    values: Float[np.ndarray, "r r r c"], where: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v c"]:
    """Interpolate trilinearly at points in voxels, all channels at once; constant outside the grid."""
    side = values.shape[0]
    where = np.clip(where, 0, side - 1 - 1e-6)
    low = where.astype(int)
    fraction = (where - low).astype(values.dtype)
    flat = values.reshape(-1, values.shape[-1])
    base = (low[:, 0] * side + low[:, 1]) * side + low[:, 2]
    result = np.zeros((len(where), values.shape[-1]), values.dtype)
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, fraction, 1 - fraction).prod(axis=1)
        result += weight[:, None] * flat[base + (corner[0] * side + corner[1]) * side + corner[2]]
    return result
