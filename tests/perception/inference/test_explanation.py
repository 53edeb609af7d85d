"""Shares of measured points that surfaces leave unexplained, and of volumes inside one another."""

import numpy as np
import pytest
import trimesh

from perception.geometry import rigid, so3_exp
from perception.inference.explanation import FAR, shared_volume, unexplained
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
    middle = np.zeros((1, 3))
    both = np.concatenate([middle, above[:1]])
    assert (unexplained(both, [can]), unexplained(both, [can], can)) == (1.0, 0.5), (
        "a cavity may be shallower"
    )


def cylinder(radius: float, height: float, T_world_object=np.eye(4)) -> ObjectEstimate:
    shape = trimesh.creation.cylinder(radius, height, sections=48)
    mesh = TriangleMesh(np.asarray(shape.vertices), np.asarray(shape.faces))
    return ObjectEstimate(0, "can", np.zeros(16), T_world_object, np.full(3, height), mesh)


def test_shared_volume_of_cylinders() -> None:
    """One that stands on end, a quarter of its length beyond the other; and one inside it, turned."""
    T = rigid(so3_exp(np.array([0.7, 0.4, 0.0])), np.array([0.5, -0.2, 0.1]))
    large = cylinder(0.04, 0.2, T)
    beyond = cylinder(0.03, 0.08, T @ rigid(np.eye(3), np.array([0.0, 0.0, 0.08])))
    assert shared_volume(beyond, large) == pytest.approx(0.75, abs=0.04)
    assert shared_volume(large, beyond) == pytest.approx(0.06 / 0.2 * (3 / 4) ** 2, abs=0.03)
    inside = cylinder(0.02, 0.05, T @ rigid(so3_exp(np.array([0.0, 0.3, 0.0])), np.zeros(3)))
    assert shared_volume(inside, large) == pytest.approx(1.0, abs=0.01)
    assert shared_volume(cylinder(0.03, 0.1), large) == 0.0
