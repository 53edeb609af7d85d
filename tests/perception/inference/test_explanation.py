"""The share of measured points that the surfaces of shapes leave unexplained."""

import numpy as np
import pytest
import trimesh

from perception.inference.explanation import FAR, unexplained
from perception.types import ObjectEstimate, TriangleMesh


def test_the_unexplained_share_counts_points_far_from_all_surfaces() -> None:
    shape = trimesh.creation.cylinder(0.03, 0.1, sections=48)
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    can = ObjectEstimate(0, "can", np.zeros(16), np.eye(4), np.full(3, 0.05), mesh)
    on_it = mesh.vertices
    above = on_it + np.array([0.0, 0.0, 0.2])
    assert unexplained(on_it, [can]) == 0.0
    assert unexplained(np.concatenate([on_it, above]), [can]) == pytest.approx(0.5)
    assert unexplained(on_it + np.array([0.0, 0.0, FAR / 2]), [can]) == 0.0
    assert unexplained(on_it, []) == 1.0
    assert unexplained(np.zeros((0, 3)), [can]) == 1.0
