"""Ground plane and initial view of a recording.

The recording of a cell contains its floor, and its world frame has z up. The world frame of a map or scan
may be arbitrary: there the support plane of the objects defines the up direction and the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.runs.finished_run import support_of
from app.runs.replay import Recorder
from app.viewer.snapshot import CAMERA, pose_matrix

STATIC_BODY = "world"
CELL_POSITION, CELL_TARGET = (1.62, -0.88, 1.0), (0.40, -0.02, 0.14)  # [m] initial view of a cell
FIELD_OF_VIEW = 0.80  # [rad]
# Initial view elsewhere: distance relative to the recorded camera's, azimuth from it, elevation.
RELATIVE_DISTANCE, AZIMUTH, ELEVATION = 1.6, np.deg2rad(50), np.deg2rad(33)
VIEWING_DISTANCE = 0.5  # [m] from a camera to the assumed centre of the scene if there are no objects
TARGET_HEIGHT = 0.04  # [m] of the view's target above the ground


@dataclass(frozen=True)
class Surroundings:
    """Ground plane and initial view.

    Attributes:
        T_world_ground: Frame on the support plane at the centre of the scene, z up.
        position, target: Camera position and target of the initial view in metres.
        has_floor: Whether the recording contains its floor.
    """

    T_world_ground: Float[np.ndarray, "4 4"]
    position: Float[np.ndarray, "3"]
    target: Float[np.ndarray, "3"]
    has_floor: bool

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        return self.T_world_ground[:3, 2]


def surroundings_of(recorder: Recorder) -> Surroundings:
    """Return ground plane and initial view of a recording."""
    cameras, has_floor = _camera_poses(recorder), STATIC_BODY in recorder.meshes
    if has_floor or not (len(cameras) or recorder.objects):
        return Surroundings(np.eye(4), np.array(CELL_POSITION), np.array(CELL_TARGET), has_floor)
    if recorder.objects:
        plane = support_of(recorder.objects, ())
        center = np.mean([estimate.T_world_object[:3, 3] for estimate in recorder.objects], axis=0)
        up, center = plane.normal, center - (center @ plane.normal - plane.offset) * plane.normal
    else:
        up = -cameras[:, :3, 1].mean(axis=0) if len(cameras) == 1 else np.array([0.0, 0.0, 1.0])
        center = (cameras[:, :3, 3] + VIEWING_DISTANCE * cameras[:, :3, 2]).mean(axis=0)
    T = np.eye(4)
    T[:3, :3] = Rotation.align_vectors(up[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    T[:3, 3] = center
    recorded = cameras[0, :3, 3] if len(cameras) else T[:3, :3] @ (0.0, -0.6, 0.4) + center
    position = center + _view_offset(T, recorded - center)
    return Surroundings(T, position, center + TARGET_HEIGHT * up, has_floor=False)


def _view_offset(
    T_world_ground: Float[np.ndarray, "4 4"], camera_offset: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Return the view's offset from the centre [m], beside the recorded camera to keep that out of view."""
    R = T_world_ground[:3, :3]
    x, y, _ = R.T @ camera_offset
    azimuth = np.arctan2(y, x) + AZIMUTH
    direction = np.cos(ELEVATION) * np.array([np.cos(azimuth), np.sin(azimuth), np.tan(ELEVATION)])
    return RELATIVE_DISTANCE * np.linalg.norm(camera_offset) * (R @ direction)


def _camera_poses(recorder: Recorder) -> Float[np.ndarray, "n 4 4"]:
    """Return the known camera poses of the images; without any, the first pose of the moving camera."""
    poses = [frame.T_world_camera for frame in recorder.frames if frame.T_world_camera is not None]
    if not poses and CAMERA in recorder.bodies and recorder.poses:
        poses = [pose_matrix(recorder.poses[0][recorder.bodies.index(CAMERA)])]
    return np.array(poses).reshape(-1, 4, 4)
