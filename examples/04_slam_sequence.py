"""Track a camera and map the objects in an RGB-D sequence with unknown camera poses.

    python examples/04_slam_sequence.py [SEQUENCE_FOLDER]

The folder is a scan folder or a TUM RGB-D recording; the pose of its first frame defines the world.
"""

import sys
import tempfile
from pathlib import Path

from sample_data import sample_sequence

import nodeslam

if len(sys.argv) > 1:
    frames = (frame for _, frame in nodeslam.open_sequence(Path(sys.argv[1])).frames())
else:
    frames = sample_sequence()

slam = nodeslam.Slam.load()
times, poses = [], []
for frame in frames:
    if not isinstance(frame, nodeslam.RgbdFrame):  # an unreadable image
        print(frame)
        continue
    result = slam.process(frame)
    print(f"frame {result.number}: {result.status}, {len(set(result.landmark_of.values()))} objects in view")
    if result.status != "lost":
        times.append(result.time)
        poses.append(result.T_world_camera)

output = Path(tempfile.mkdtemp(prefix="nodeslam_slam_"))
nodeslam.write_object_map(output, slam.object_estimates())
nodeslam.write_trajectory(output / "trajectory.txt", nodeslam.Trajectory.of(times, poses))
print(f"object map and trajectory in {output}")
