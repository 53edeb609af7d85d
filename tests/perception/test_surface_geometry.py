"""Measures of triangle meshes, against known solids and trimesh."""

import numpy as np
import pytest
import trimesh

from perception.surface_geometry import centre_of_mass, mesh_edges, surface_area, vertex_normals
from perception.types import TriangleMesh


def mesh_of(solid):
    return TriangleMesh(solid.vertices, solid.faces)


@pytest.fixture(scope="module")
def solid():
    """An irregular closed surface."""
    ball = trimesh.creation.icosphere(3, 0.04)
    wobble = 1 + 0.2 * np.sin(90 * ball.vertices[:, :1]) + 0.1 * np.cos(70 * ball.vertices[:, 1:2])
    return trimesh.Trimesh(
        ball.vertices * wobble * (1, 1.4, 0.7) + (0.2, -0.3, 0.5), ball.faces, process=False
    )


def test_measures_of_a_box():
    box = mesh_of(
        trimesh.creation.box((0.1, 0.2, 0.3), trimesh.transformations.translation_matrix((1, 2, 3)))
    )
    assert surface_area(box) == pytest.approx(2 * (0.02 + 0.03 + 0.06))
    np.testing.assert_allclose(centre_of_mass(box), (1, 2, 3))
    assert len(mesh_edges(box.faces)) == 18  # twelve, and a diagonal on each side
    np.testing.assert_allclose(vertex_normals(box), np.sign(box.vertices - (1, 2, 3)) / np.sqrt(3))


def test_measures_equal_those_of_trimesh(solid):
    mesh = mesh_of(solid)
    assert surface_area(mesh) == pytest.approx(solid.area, rel=1e-12)
    np.testing.assert_allclose(centre_of_mass(mesh), solid.center_mass, atol=1e-12)
    np.testing.assert_allclose(vertex_normals(mesh), solid.vertex_normals, atol=1e-9)
    assert {tuple(e) for e in mesh_edges(mesh.faces)} == {tuple(sorted(e)) for e in solid.edges_unique}


def test_degenerate_triangles_do_not_turn_the_normals(solid):
    faces = np.vstack([solid.faces, [[0, 0, 1], [2, 2, 2]]])
    mesh = TriangleMesh(np.vstack([solid.vertices, [[9, 9, 9]]]), faces)
    normals = vertex_normals(mesh)
    np.testing.assert_allclose(normals[:-1], solid.vertex_normals, atol=1e-9)
    np.testing.assert_array_equal(normals[-1], 0)
