"""Meshes for viewers."""

import numpy as np
import pytest
import trimesh
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
    assert len(mesh.faces) > LARGEST_MESH >= len(simple.faces) > 0.9 * LARGEST_MESH
    np.testing.assert_allclose(np.linalg.norm(simple.vertices, axis=1), 0.05, rtol=0.01)
    assert simple.volume == pytest.approx(mesh.volume, rel=0.01)
    visual = simple.visual
    assert isinstance(visual, TextureVisuals) and visual.material is mesh.visual.material
    if textured:
        assert visual.uv is not None
        np.testing.assert_allclose(visual.uv, simple.vertices[:, :2] / 0.1 + 0.5, atol=0.03)


def test_small_meshes_stay_as_they_are() -> None:
    mesh = ball(2, textured=True)
    assert _simplified(mesh) is mesh
