"""Reconstruct the objects in one RGB-D image given as numpy arrays, without a camera pose.

    python examples/01_reconstruct_image.py [rgb.png depth.png fx,fy,cx,cy]

The depth image is uint16 in millimetres, registered to the colour image.
"""

import sys

import numpy as np
from PIL import Image
from sample_data import sample_frames

import nodeslam

if len(sys.argv) == 4:
    color = np.asarray(Image.open(sys.argv[1]).convert("RGB"))
    depth = np.asarray(Image.open(sys.argv[2]))
    fx, fy, cx, cy = map(float, sys.argv[3].split(","))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
else:
    frame = next(sample_frames())
    color, depth, K = frame.rgb, frame.depth, frame.intrinsics.matrix

scene = nodeslam.reconstruct_image(color, depth, K)

print(f"{len(scene.objects)} objects; poses are in the camera frame (x right, y down, z forward)")
for item in scene.objects:
    x, y, z = item.T_world_object[:3, 3]
    assert item.surface_sigma is not None  # every fitted object has one
    sigma = 1000 * np.median(item.surface_sigma)
    print(
        f"{item.name}: at ({x:.3f}, {y:.3f}, {z:.3f}) m, height {item.height:.3f} m, score {item.score:.2f}, "
        f"{len(item.mesh.vertices)} vertices, median standard deviation {sigma:.1f} mm"
    )
