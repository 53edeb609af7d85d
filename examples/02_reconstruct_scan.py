"""Reconstruct a scan folder (BOP layout) of several views and write the object map.

python examples/02_reconstruct_scan.py [SCAN_FOLDER [OUTPUT_FOLDER]]
"""

import sys
import tempfile
from pathlib import Path

from sample_data import sample_scan

import nodeslam

folder = Path(sys.argv[1]) if len(sys.argv) > 1 else sample_scan()
output = Path(sys.argv[2]) if len(sys.argv) > 2 else Path(tempfile.mkdtemp(prefix="nodeslam_map_"))

scan = nodeslam.read_scan(folder)
networks = nodeslam.load_perception("auto")

# The stages one by one; nodeslam.reconstruct_scan(folder) is the same in one call.
surfaces = nodeslam.find_surfaces(scan.frames)
detections = nodeslam.detect(scan.frames, networks.detector, surfaces=surfaces)
scene = nodeslam.reconstruct(scan.frames, networks, detections)

for item in scene.objects:
    x, y, _ = item.T_world_object[:3, 3]
    print(f"{item.name}: at ({x:.3f}, {y:.3f}) m, seen in {item.n_views} views, {item.status}")

for candidate in detections.left_out:
    print(f"left out in image {candidate.frame}: {candidate.text}")

nodeslam.write_object_map(output, scene.objects)
assert [item.name for item in nodeslam.read_object_map(output)] == [item.name for item in scene.objects]
print(f"object map with meshes in {output}")
