"""The recording: camera poses, changes of status and keyframes."""

import numpy as np

from app.slam.recording import SlamRecorder, camera_mesh
from perception.slam.frame_result import FrameResult
from perception.slam.system import Slam


def result(number, status="tracked", is_keyframe=False):
    T = np.eye(4)
    T[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # a quarter turn about z
    T[:3, 3] = number, 2.0, 3.0
    return FrameResult(number, number / 10, T, status, is_keyframe=is_keyframe)


def recorded(*results):
    slam = object.__new__(Slam)
    slam.mapper = None
    recorder = SlamRecorder()
    for each in results:
        recorder.add(each, slam)
    return recorder._recorder


def test_changes_of_status_and_keyframes_are_noted():
    recorder = recorded(
        result(0, is_keyframe=True), result(1, "lost"), result(2, "lost"), result(3, "weak", True)
    )
    stages = [note.data["name"] for note in recorder.notes if note.kind == "stage"]
    assert stages == ["slam", "lost", "slam"]
    assert [note.data["index"] for note in recorder.notes if note.kind == "look"] == [0, 1]


def test_the_camera_mesh_is_a_frustum_along_z():
    mesh = camera_mesh(0.03)
    assert mesh.is_watertight and mesh.volume > 0
    np.testing.assert_allclose(mesh.bounds[:, 2], [0, 0.03], atol=1e-12)
    np.testing.assert_allclose(mesh.bounds[:, 0], [-0.021, 0.021])
