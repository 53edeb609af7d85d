"""Reconstruct the objects in one RGB-D image given as numpy arrays, without a camera pose.

    python examples/01_reconstruct_image.py [rgb.png depth.png fx,fy,cx,cy]

The depth image is uint16 in millimetres, registered to the colour image.
"""

import sys

import cv2
import numpy as np
from sample_data import sample_frames

import nodeslam

if len(sys.argv) == 4:
    color = cv2.cvtColor(cv2.imread(sys.argv[1]), cv2.COLOR_BGR2RGB)
    depth = cv2.imread(sys.argv[2], cv2.IMREAD_UNCHANGED)
    fx, fy, cx, cy = map(float, sys.argv[3].split(","))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
else:
    frame = next(sample_frames())
    color, depth, K = frame.rgb, frame.depth, frame.intrinsics.matrix

scene = nodeslam.reconstruct_image(color, depth, K)

print(f"{len(scene.objects)} objects; poses are in the camera frame (x right, y down, z forward)")
for item in scene.objects:
    x, y, z = item.T_world_object[:3, 3]
    sigma = 1000 * np.median(item.surface_sigma)
    print(
        f"{item.name}: at ({x:.3f}, {y:.3f}, {z:.3f}) m, height {item.height:.3f} m, score {item.score:.2f}, "
        f"{len(item.mesh.vertices)} vertices, median standard deviation {sigma:.1f} mm"
    )
