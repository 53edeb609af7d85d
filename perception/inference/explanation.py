"""How much of what was measured of an object the surface of its fitted shape explains."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from perception.metrics import SurfaceSamples
from perception.types import ObjectEstimate

FAR = 0.008  # [m] from the surface of a shape, from which on it does not explain a measured point
SAMPLES = 6000  # of a surface


def unexplained(points: Float[np.ndarray, "n 3"], shapes: Sequence[ObjectEstimate]) -> float:
    """Return the share of measured points farther than ``FAR`` from the surfaces of shapes; 1 without any."""
    if not shapes or not len(points):
        return 1.0
    rng = np.random.default_rng(0)
    trees = [SurfaceSamples.of(shape.mesh_world, rng, SAMPLES).tree for shape in shapes]
    nearest = np.min([tree.query(points, distance_upper_bound=2 * FAR)[0] for tree in trees], axis=0)
    return float((nearest > FAR).mean())
