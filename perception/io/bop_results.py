"""Object poses in the CSV format of the BOP toolkit (bop19), for comparison with other pose estimators.

    scene_id,im_id,obj_id,score,R,t,time
    https://github.com/thodan/bop_toolkit

NodeSLAM estimates the shape with the pose, so there is no model whose pose it could report: ``obj_id`` is
the number of the class, and the model frame has z up, the handle of a mug along +x, and its origin in the
centre of the bounding box. A ground truth with models in such frames can be compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.geometry import transform_points
from perception.io.files import write_atomically
from perception.types import CATEGORIES, CameraIntrinsics, Category, ObjectEstimate

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
OBJECT_IDS: dict[Category, int] = {category: number for number, category in enumerate(CATEGORIES, start=1)}


@dataclass(frozen=True)
class PosedImage:
    """An image of a scene, with its estimated or given camera pose.

    Attributes:
        id: Number of the image in its folder.
        T_world_camera: Pose of the camera.
        intrinsics: Pinhole parameters.
    """

    id: int
    T_world_camera: Float[np.ndarray, "4 4"]
    intrinsics: CameraIntrinsics


def write_bop_results(
    path: Path, scene: Path, objects: Sequence[ObjectEstimate], images: Sequence[PosedImage], seconds: float
) -> None:
    """Write one line for each object in the field of view of each image.

    Args:
        path: File to write.
        scene: Folder of the images; its name is the number of the scene in a BOP data set, otherwise 0.
        objects: Object map.
        images: Images.
        seconds: Time of the whole computation; each image gets an equal share.
    """
    scene_id = int(scene.resolve().name) if scene.resolve().name.isdecimal() else 0
    share = seconds / max(len(images), 1)
    lines = [HEADER]
    for image in images:
        T_camera_world = np.linalg.inv(image.T_world_camera)
        for estimate in objects:
            T_camera_model = T_camera_world @ model_pose(estimate)
            T_camera_object = T_camera_world @ estimate.T_world_object
            if in_view(transform_points(T_camera_object, estimate.mesh.vertices), image.intrinsics):
                R = " ".join(f"{x:.9f}" for x in T_camera_model[:3, :3].ravel())
                t = " ".join(f"{1000 * x:.6f}" for x in T_camera_model[:3, 3])
                score = min(max(float(estimate.score), 0.0), 1.0)
                number = OBJECT_IDS[estimate.category]
                lines.append(f"{scene_id},{image.id},{number},{score:.6f},{R},{t},{share:.6f}")
    write_atomically(path, "\n".join(lines) + "\n")


def model_pose(estimate: ObjectEstimate) -> Float[np.ndarray, "4 4"]:
    """Return the pose of the centre of the bounding box of an estimate, in the world frame."""
    low, high = estimate.mesh.vertices.min(axis=0), estimate.mesh.vertices.max(axis=0)
    T_object_model = np.eye(4)
    T_object_model[:3, 3] = (low + high) / 2
    return estimate.T_world_object @ T_object_model


def in_view(points: Float[np.ndarray, "n 3"], camera: CameraIntrinsics) -> bool:
    """Return whether any point of the camera frame [m] is in front of the camera and within the image."""
    x, y, z = points[points[:, 2] > 0].T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool(np.any((u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)))
