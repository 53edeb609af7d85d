"""GLB: one named node for each object, coloured by class, y up as glTF requires."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from app.drawing import CLASS_COLORS
from perception.types import ObjectEstimate

Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # from z up


def glb_bytes(objects: Sequence[ObjectEstimate]) -> bytes:
    """Return a GLB file of the objects: nodes ``<class>_<id>`` under ``world``, meshes in object frames."""
    scene = trimesh.Scene(base_frame="root")
    scene.graph.update(frame_to="world", frame_from="root", matrix=Y_UP)
    for estimate in objects:
        color = (*CLASS_COLORS[estimate.category], 255)
        paint = PBRMaterial(
            name=estimate.category, baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.55
        )
        mesh = trimesh.Trimesh(estimate.mesh.vertices, estimate.mesh.faces, process=False)
        mesh.visual = TextureVisuals(material=paint)
        scene.add_geometry(
            mesh,
            node_name=estimate.name,
            geom_name=estimate.name,
            parent_node_name="world",
            transform=estimate.T_world_object,
        )
    content = scene.export(file_type="glb", include_normals=True)
    assert isinstance(content, bytes)
    return content
