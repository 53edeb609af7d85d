"""Recording of a SLAM run for the viewer: the camera as a moving body, objects as they change.

In the format of ``app.runs.replay``, with one body, ``camera``, and no joints. ``look`` notes count
keyframes, whose images are in ``scan/``; a ``fit`` note gives an object's shape and pose from its time on.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from app.runs.replay import Recorder
from perception.rendering.pose import ObjectPose
from perception.slam.frame_result import FrameResult
from perception.slam.system import Slam

BODY = "camera"


class SlamRecorder:
    """Collect the recording frame by frame."""

    def __init__(self) -> None:
        self._recorder = Recorder(bodies=(BODY,), meshes={BODY: (camera_mesh(),)})
        self._recorded: dict[int, ObjectPose] = {}
        self._keyframes = 0
        self._lost = False
        self._recorder.note("stage", name="slam")

    def add(self, result: FrameResult, slam: Slam) -> None:
        """Add the camera pose of one frame, its status and keyframe, and the objects that changed."""
        recorder = self._recorder
        T = result.T_world_camera
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        recorder.sample(result.time, np.zeros(0), 0.0, np.array([[*T[:3, 3], w, x, y, z]]))
        if (result.status == "lost") != self._lost:
            self._lost = not self._lost
            recorder.note("stage", name="lost" if self._lost else "slam")
        if result.is_keyframe:
            recorder.note("look", index=self._keyframes)
            self._keyframes += 1
        if slam.world is None:
            return
        for id, landmark in slam.world.landmarks.items():
            if self._recorded.get(id) is landmark.state.pose:
                continue
            self._recorded[id] = landmark.state.pose
            recorder.note(
                "fit",
                id=id,
                category=landmark.category,
                code=landmark.state.code,
                T_world_object=landmark.state.pose.T_world_object,
                scale=landmark.state.pose.scale,
                residual=landmark.residual,
                iteration=landmark.n_updates,
            )

    def write(self, folder: Path) -> None:
        """Write the recording and the camera's mesh to a run folder."""
        self._recorder.note("objects", covariances={})
        self._recorder.write(folder)
        self._recorder.write_meshes(folder)


def camera_mesh(size: float = 0.03) -> trimesh.Trimesh:
    """Return a viewing frustum along +z with its tip at the camera centre; ``size`` is its length [m]."""
    corners: Float[np.ndarray, "5 3"] = size * np.array(
        [[0, 0, 0], [-0.7, -0.5, 1], [0.7, -0.5, 1], [0.7, 0.5, 1], [-0.7, 0.5, 1]], dtype=np.float64
    )
    faces = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4], [1, 2, 3], [1, 3, 4]]
    green = np.tile(np.array([[40, 150, 90, 255]], np.uint8), (5, 1))
    return trimesh.Trimesh(corners, faces, vertex_colors=green, process=False)
