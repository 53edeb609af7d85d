"""How much of what was measured of an object shapes explain, and how much of its volume they share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.geometry import invert, transform_points
from perception.inference.voxelise import voxels_of
from perception.metrics import SurfaceSamples
from perception.obstacles.obstacle import is_within
from perception.types import GRID_RESOLUTION, ObjectEstimate

FAR = 0.008  # [m] from the surface of a shape, from which on it does not explain a measured point
SAMPLES = 6000  # of a surface


def unexplained(
    points: Float[np.ndarray, "n 3"], shapes: Sequence[ObjectEstimate], vessel: ObjectEstimate | None = None
) -> float:
    """Return the share of measured points farther than ``FAR`` from the surfaces of shapes; 1 without any.

    Args:
        points: Measured points in the world frame, in metres.
        shapes: The shapes.
        vessel: One whose cavity may be shallower than that of its shape: points in its convex hull count as
            explained.
    """
    if not shapes or not len(points):
        return 1.0
    rng = np.random.default_rng(0)
    trees = [SurfaceSamples.of(shape.mesh_world, rng, SAMPLES).tree for shape in shapes]
    nearest = np.min([tree.query(points, distance_upper_bound=2 * FAR)[0] for tree in trees], axis=0)
    is_open = nearest > FAR
    if vessel is not None:
        is_open &= ~is_within(points, vessel.mesh_world.vertices)
    return float(is_open.mean())


def shared_volume(shape: ObjectEstimate, other: ObjectEstimate) -> float:
    """Return the share of a shape's volume that is inside another one, in 0..1."""
    grid, scale = voxels_of(shape.mesh)
    centres = (2 * np.argwhere(grid > 0.5) + 1) / GRID_RESOLUTION - 1
    if not len(centres):
        return 0.0
    T_other_shape = invert(other.T_world_object) @ shape.T_world_object
    grid, other_scale = voxels_of(other.mesh)
    points = transform_points(T_other_shape, centres * scale) / other_scale
    cells = np.floor((points + 1) * GRID_RESOLUTION / 2).astype(int)
    within = ((cells >= 0) & (cells < GRID_RESOLUTION)).all(axis=1)
    return float((grid[tuple(cells[within].T)] > 0.5).sum() / len(centres))
