"""Inside test and handle of mesh files against closed forms."""

import numpy as np
import pytest
import trimesh

from sim_assets.objects import mesh_shape
from sim_assets.objects.mesh_shape import MeshShape


def standing(mesh):
    return mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))


@pytest.fixture(scope="module")
def cup():
    """A cup of radius 40 mm and height 80 mm with 5 mm of wall and floor, and a bar for a handle."""
    body, cavity = (standing(trimesh.creation.cylinder(r, 0.08, sections=64)) for r in (0.04, 0.035))
    bar = trimesh.creation.box((0.025, 0.01, 0.03)).apply_translation((0.05, 0, 0.04))
    body = trimesh.boolean.difference([body, cavity.apply_translation((0, 0, 0.005))], engine="manifold")
    return MeshShape(trimesh.boolean.union([body, bar], engine="manifold"), "mug")


def test_inside_of_a_box_with_rays_along_edges_and_vertices():
    box = MeshShape(standing(trimesh.creation.box((0.1, 0.2, 0.3))), "can")
    np.testing.assert_allclose(box.bounds, [(-0.05, -0.1, 0), (0.05, 0.1, 0.3)])
    axis = np.linspace(-0.25, 0.35, 13)
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    depth = (np.abs(points - (0, 0, 0.15)) - (0.05, 0.1, 0.15)).max(axis=1)
    clear = np.abs(depth) > 1e-6
    np.testing.assert_array_equal(box.inside(points[clear]), depth[clear] < 0)


def test_inside_of_a_ball():
    ball = MeshShape(trimesh.creation.icosphere(subdivisions=4, radius=0.05), "can")
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (60_000, 3))  # more than one chunk
    r = np.linalg.norm(points, axis=1)
    clear = np.abs(r - 0.05) > 2e-4
    np.testing.assert_array_equal(ball.inside(points)[clear], (r < 0.05)[clear])
    assert not ball.inside(np.zeros((0, 3))).any()


def test_cavity_is_outside_and_wall_floor_and_handle_are_inside(cup):
    points = {
        (0.0, 0.0, 0.04): False, (0.0, 0.0, 0.002): True, (-0.037, 0.0, 0.04): True, (0.0, 0.037, 0.07): True,
        (-0.03, 0.0, 0.079): False, (0.05, 0.0, 0.04): True, (0.05, 0.0, 0.06): False,
        (0.05, 0.01, 0.04): False, (0.0, 0.0, -0.01): False, (0.0, 0.0, 0.09): False,
    }  # fmt: skip
    np.testing.assert_array_equal(cup.inside(np.array(list(points))), list(points.values()))


def test_handle_points_lie_towards_x_beyond_the_body(cup):
    points = {
        (0.05, 0.0, 0.04): True, (0.0615, 0.005, 0.04): True, (0.0425, 0.0, 0.04): True,
        (0.041, 0.0, 0.04): False, (-0.05, 0.0, 0.04): False, (0.0, 0.05, 0.04): False,
        (0.03, 0.04, 0.04): False, (0.037, 0.0, 0.04): False,
    }  # fmt: skip
    np.testing.assert_array_equal(cup.is_handle(np.array(list(points))), list(points.values()))
    bowl = MeshShape(cup.mesh, "bowl")
    assert not bowl.is_handle(np.array(list(points))).any()


def test_result_does_not_depend_on_the_number_of_buckets(cup, monkeypatch):
    points = np.random.default_rng(1).uniform(*cup.bounds, (2000, 3))
    expected = cup.inside(points)
    monkeypatch.setattr(mesh_shape, "CELLS", 7)
    np.testing.assert_array_equal(MeshShape(cup.mesh, "mug").inside(points), expected)
