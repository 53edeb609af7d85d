"""Objects as a perfect shape prior would reconstruct them."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from perception.inference.meshing import mesh_from_grid
from perception.types import Category, ObjectEstimate, TriangleMesh
from sim_assets.objects import canonical_scale, occupancy_grid, sample_object


@cache
def _decoded(category: Category) -> TriangleMesh:
    model = sample_object(category, "test", np.random.default_rng(1))
    scale = np.full(3, canonical_scale(model)[0])
    return mesh_from_grid(occupancy_grid(model), scale, category)


@pytest.fixture
def decoded() -> Callable[[Category], TriangleMesh]:
    """The mesh of a generated object after a passage through the 32³ grid, by class; object frame."""
    return _decoded


@pytest.fixture
def standing() -> Callable[..., ObjectEstimate]:
    """The decoded object of a class as an estimate that stands on z = 0 at (x, y)."""

    def estimate(category: Category, number: int = 0, at: tuple[float, float] = (0.0, 0.0)) -> ObjectEstimate:
        mesh = _decoded(category)
        T = np.eye(4)
        T[:3, 3] = (*at, -mesh.vertices[:, 2].min())
        return ObjectEstimate(number, category, np.zeros(16), T, np.full(3, 0.1), mesh)

    return estimate
