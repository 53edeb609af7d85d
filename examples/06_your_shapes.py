"""Reconstruct shapes of your own in the simulated cell and compare their sizes with the true ones.

    python examples/06_your_shapes.py [FOLDER]

The folder holds FOLDER/<class>/*.{ply,obj,glb,stl}: watertight meshes in metres, z up.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

import nodeslam


def sample_meshes() -> Path:
    """Write a bowl that no family of the training set contains: conical, 14 cm wide."""
    folder = Path(tempfile.mkdtemp(prefix="nodeslam_shapes_"))
    (folder / "bowl").mkdir()
    outline = [(0, 0), (0.04, 0), (0.07, 0.055), (0.066, 0.055), (0.037, 0.004), (0, 0.004)]
    trimesh.creation.revolve(np.array(outline), sections=64).export(folder / "bowl" / "cone.ply")
    return folder


models = nodeslam.load_user_objects(Path(sys.argv[1]) if len(sys.argv) > 1 else sample_meshes())[:6]
with nodeslam.World(nodeslam.CellConfig(tuple(models), seed=2)) as cell:
    frames = nodeslam.ViewpointScanner(cell, nodeslam.Kinematics(cell.arm)).capture(
        nodeslam.SCAN_VIEWPOINTS[:3]
    )
scene = nodeslam.reconstruct(frames)

print("true:", ", ".join(f"{model.category} {model.name}, height {model.height:.4f} m" for model in models))
for item in scene.objects:
    print(
        f"found: {item.name}, height {item.height:.4f} m, radius {item.radius:.4f} m, score {item.score:.2f}"
    )
