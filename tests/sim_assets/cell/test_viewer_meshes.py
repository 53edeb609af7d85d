"""Meshes for viewers."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from sim_assets.cell.viewer_meshes import LARGEST_MESH, _simplified


def ball(subdivisions: int, textured: bool) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions, 0.05)
    uv = mesh.vertices[:, :2] / 0.1 + 0.5 if textured else None
    mesh.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorFactor=(10, 20, 30, 255)))
    return mesh


@pytest.mark.parametrize("textured", [True, False])
def test_large_meshes_become_simple_and_keep_shape_and_texture(textured) -> None:
    mesh = ball(5, textured)
    simple = _simplified(mesh)
    assert len(mesh.faces) > LARGEST_MESH >= len(simple.faces) > 0.3 * LARGEST_MESH
    np.testing.assert_allclose(np.linalg.norm(simple.vertices, axis=1), 0.05, rtol=0.01)
    assert simple.volume == pytest.approx(mesh.volume, rel=0.01)
    visual = simple.visual
    assert isinstance(visual, TextureVisuals) and visual.material is mesh.visual.material
    if textured:
        assert visual.uv is not None
        np.testing.assert_allclose(visual.uv, simple.vertices[:, :2] / 0.1 + 0.5, atol=0.03)


@pytest.mark.parametrize("is_solid", [True, False])
@pytest.mark.parametrize("sections", [8, 160], ids=["octagonal", "conical"])
def test_flat_and_conical_walls_keep_their_place(sections, is_solid) -> None:
    steps = np.linspace(0.0, 1.0, 60)[:, None]
    wall = np.array([0.05, 0.0]) + steps * [0.02, 0.06]
    profile = np.concatenate([[(0.0, 0.0)], wall, wall[::-1] - [0.003, -0.002], [(0.0, 0.002)]])
    mesh = trimesh.creation.revolve(profile, sections=sections)
    for _ in range(2 if sections == 8 else 0):
        mesh = mesh.subdivide()
    if not is_solid:
        mesh = mesh.submesh([np.flatnonzero(mesh.triangles_center[:, 0] > -0.03)], append=True)
    mesh.visual = TextureVisuals(material=PBRMaterial())
    simple = _simplified(mesh)
    assert len(mesh.faces) > LARGEST_MESH >= len(simple.faces)
    assert cKDTree(mesh.vertices).query(simple.vertices)[0].max() < 1e-6
    points, dense = (
        trimesh.sample.sample_surface(m, n, seed=0)[0] for m, n in ((simple, 2000), (mesh, 50000))
    )
    assert cKDTree(dense).query(points)[0].max() < 0.006
    np.testing.assert_allclose(simple.bounds, mesh.bounds, atol=0.002)


def test_of_many_small_parts_some_remain() -> None:
    parts = [
        trimesh.creation.box((0.001,) * 3).apply_translation((0.01 * (k % 30), 0.01 * (k // 30), 0))
        for k in range(600)
    ]
    mesh = trimesh.util.concatenate(parts)
    mesh.visual = TextureVisuals(material=PBRMaterial())
    assert len(mesh.faces) > LARGEST_MESH >= len(_simplified(mesh).faces) > 0


def test_small_meshes_stay_as_they_are() -> None:
    mesh = ball(2, textured=True)
    assert _simplified(mesh) is mesh
