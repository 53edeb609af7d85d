"""Compute grasps for a motion planner of your own: no robot model, only the gripper's geometry.

python examples/03_grasps_for_your_planner.py
"""

from sample_data import sample_frames

import nodeslam

frame = next(sample_frames())
scene = nodeslam.reconstruct_image(frame.rgb, frame.depth, frame.intrinsics.matrix)

# Geometry of your parallel gripper, in metres.
gripper = nodeslam.GripperGeometry(max_width=0.085, tip=0.012, palm=0.06)

# The camera pose from your hand-eye calibration: grasps come in the camera's and in the world's frame.
grasps = nodeslam.find_grasps(scene, gripper, T_world_camera=frame.T_world_camera)

for item in scene.objects:
    candidates = [grasp for grasp in grasps if grasp.object_id == item.id]
    if not candidates:
        print(f"{item.name}: no collision-free grasp")
        continue
    best = candidates[0]
    print(
        f"{item.name}: {len(candidates)} grasps; best: {best.grasp.kind}, score {best.score:.2f}, "
        f"open to {1000 * best.opening:.0f} mm, TCP at {best.T_world_tcp[:3, 3].round(3)} m, "
        f"approach from {best.pregrasp(0.10)[:3, 3].round(3)} m"
    )
