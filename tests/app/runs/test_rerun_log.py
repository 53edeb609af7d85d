"""Recordings for rerun: what is logged, and the file as its own reader sees it."""

import sys
from collections import Counter

import numpy as np
import pytest
import trimesh

from app.errors import MissingExtraError
from app.runs.replay import Recorder
from app.runs.rerun_log import FILE, require_rerun, write_rerun
from perception.types import CameraIntrinsics, RgbdFrame


@pytest.fixture
def recorder(can_at):
    """Two samples of one body that moves, an image, and a map of one can."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    recorder = Recorder(bodies=("box",), meshes={"box": (mesh,)})
    recorder.note("stage", name="scan")
    for step in range(2):
        pose = np.array([[0.1 * step, 0, 0, 1, 0, 0, 0]])
        recorder.sample(0.5 * step, np.array([0.1, 0.2]) * step, 0.08, pose)
    lens = CameraIntrinsics(8, 6, 9.0, 9.0, 3.5, 2.5)
    recorder.frames.append(
        RgbdFrame(0.0, np.zeros((6, 8, 3), np.uint8), np.ones((6, 8), np.float32), lens, np.eye(4))
    )
    recorder.note("look", index=0)
    recorder.note("action", phase="grasp", name="can_0", message="", done=0, total=1)
    recorder.objects = (can_at(),)
    return recorder


def test_without_rerun(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtraError, match=r"\[rerun\]"):
        require_rerun()


class StandIn:
    """Stands for the module and for every object in it; keeps the names of what is logged."""

    def __init__(self):
        self.entities, self.saved = [], []

    def __getattr__(self, name):
        return self

    def __call__(self, *arguments, **named):
        return self

    def log(self, entity, *shape, static=False):
        self.entities.append(entity)

    def send_columns(self, entity, times, columns):
        self.entities.append(entity)

    def save(self, path):
        self.saved.append(path)


def test_everything_is_logged(recorder, tmp_path, monkeypatch):
    rerun = StandIn()
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    require_rerun()
    write_rerun(recorder, tmp_path)
    assert rerun.saved == [str(tmp_path / FILE)]
    assert set(rerun.entities) == {
        "world", "world/bodies/box/0", "world/bodies/box", "joints/0", "joints/1", "gripper_width", "events",
        "world/camera", "world/camera/image", "world/camera/image/rgb", "world/camera/image/depth",
        "world/map/can_0",
    }  # fmt: skip
    assert rerun.entities.count("events") == 2


def test_the_real_library_writes_a_file(recorder, tmp_path):
    pytest.importorskip("rerun")
    write_rerun(recorder, tmp_path)
    assert (tmp_path / FILE).read_bytes()[:4] in (b"RRF2", b"RRF0", b"RRIO")


def test_the_file_as_the_librarys_own_reader_sees_it(recorder, tmp_path):
    chunks = pytest.importorskip("rerun.chunk")  # from 0.41 on
    write_rerun(recorder, tmp_path)
    rows = Counter()
    for chunk in chunks.RrdReader(tmp_path / FILE).stream():
        rows[str(chunk.entity_path)] += chunk.num_rows
    assert rows["/world/bodies/box"] == rows["/gripper_width"] == rows["/joints/1"] == 2  # samples
    assert rows["/world/bodies/box/0"] == rows["/world/map/can_0"] == 1
    assert rows["/events"] == 2 and rows["/world/camera/image/depth"] == 1
