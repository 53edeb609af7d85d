from types import SimpleNamespace

import numpy as np
import pytest

import app.task.recording as recording
from app.task.recording import CellRecorder
from manipulation.execution import TaskEvent
from perception.geometry import pose_from_yaw
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import ObjectDetection, SupportPlane
from sim_assets.robots import panda


@pytest.fixture
def recorder(still_world, monkeypatch):
    """Of a cell with one moving body, the tool, and one object."""
    still_world._robot = panda()
    poses = {0: pose_from_yaw(np.pi / 2, np.array([0.4, -0.2, 0.0]))}
    monkeypatch.setattr(
        recording, "read_truth", lambda world: SimpleNamespace(models={0: None}, poses=poses, unknown={})
    )
    meshes = recording.viewer_meshes
    monkeypatch.setattr(meshes, "moving_bodies", lambda world: ("tcp",))
    monkeypatch.setattr(meshes, "body_meshes", lambda world: {})
    monkeypatch.setattr(meshes, "poses", lambda world: np.array([[0.5, 0, 0.3, 1, 0, 0, 0]], dtype=float))
    return CellRecorder(still_world)


def notes(recorder):
    return [(note.kind, note.data) for note in recorder.recorder.notes]


def test_samples_hold_the_robot_and_the_true_objects(recorder, still_world):
    still_world.time = 2.0
    recorder.sample()
    kept = recorder.recorder
    assert kept.bodies == ("tcp", "object0") and kept.times == [1.5, 2.0]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(kept.poses[-1][1], (0.4, -0.2, 0.0, half, 0, 0, half), atol=1e-9)
    np.testing.assert_allclose(kept.poses[-1][0], (0.5, 0, 0.3, 1, 0, 0, 0))
    assert kept.widths[-1] == 0.08 and len(kept.joints[-1]) == 7


def test_stages_images_and_results_become_notes(recorder, overhead_frame, can_at, pack_plan):
    recorder.begin_stage("scan")
    recorder.on_image(overhead_frame)
    recorder.end_stage("scan", 1.23456)
    mask = np.ones((120, 160), bool)
    found = (ObjectDetection("can", 0.9, mask, instance_id=0),) * 2
    recorder.on_detections(Detections(SupportPlane(), (found,)))
    covariance = np.arange(625.0).reshape(25, 25)
    estimate = can_at()
    object.__setattr__(estimate, "covariance", covariance)
    recorder.on_objects([estimate, can_at(1)])
    recorder.on_obstacles([PerceivedObstacle(0, (np.eye(4)[:, :3],), 500)])
    recorder.on_plan(pack_plan)
    kinds = [kind for kind, _ in notes(recorder)]
    assert kinds == ["stage", "look", "done", "found", "objects", "obstacles", "plan"]
    data = [data for _, data in notes(recorder)]
    assert data[0] == {"name": "scan"} and data[1] == {"index": 0}
    assert data[2] == {"name": "scan", "seconds": 1.23} and data[3] == {"index": 0, "count": 2}
    assert list(data[4]["covariances"]) == ["0"] and len(data[4]["covariances"]["0"]) == 25 * 26 / 2
    assert data[4]["covariances"]["0"][:3] == [0, 1, 2] and data[4]["covariances"]["0"][25] == 26
    np.testing.assert_array_equal(data[5]["pieces"]["thing_0"], [np.eye(4)[:, :3]])
    (placement,) = data[6]["placements"]
    assert placement["name"] == "can_0" and placement["position"] == (0.5, 0.27, 0.004)
    assert data[6]["left_out"] == {"can_1": "too far"}
    assert recorder.recorder.frames == [overhead_frame] and len(recorder.recorder.objects) == 2


def test_events_become_actions(recorder):
    recorder.on_event(TaskEvent("retry", "can_0", 1, 3, "lost"))
    expected = {"phase": "retry", "name": "can_0", "message": "lost", "done": 1, "total": 3}
    assert notes(recorder) == [("action", expected)]
