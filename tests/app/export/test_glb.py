"""GLB: node names, y up, metres, class colours."""

from __future__ import annotations

import io

import numpy as np
import trimesh

from app.drawing import CLASS_COLORS
from app.export.glb import glb_bytes


def test_z_up_becomes_y_up(box_body):
    """glTF: +y up and right-handed, so (x, y, z) of the world is (x, z, -y) of the file."""
    scene = trimesh.load(io.BytesIO(glb_bytes([box_body.estimate])), file_type="glb")
    T, geometry = scene.graph["bottle_7"]
    shown = scene.geometry[geometry].vertices @ T[:3, :3].T + T[:3, 3]
    world = box_body.estimate.mesh_world.vertices
    expected = np.stack([world[:, 0], world[:, 2], -world[:, 1]], axis=1)
    for points in (shown, expected):
        points[:] = np.round(points, 6)
    assert {tuple(p) for p in shown} == {tuple(p) for p in expected}
    np.testing.assert_allclose(scene.geometry[geometry].extents, (0.04, 0.06, 0.10), atol=1e-6)


def test_material_has_the_colour_of_the_class_and_is_no_metal(box_body):
    scene = trimesh.load(io.BytesIO(glb_bytes([box_body.estimate])), file_type="glb")
    material = scene.geometry[scene.graph["bottle_7"][1]].visual.material
    np.testing.assert_allclose(np.asarray(material.baseColorFactor)[:3], CLASS_COLORS["bottle"], atol=1)
    assert material.name == "bottle" and material.metallicFactor == 0.0 and material.roughnessFactor == 0.55
