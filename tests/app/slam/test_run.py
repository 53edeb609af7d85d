"""A run on a sequence: unreadable frames, durations, trajectory and the source of detections."""

from pathlib import Path

import numpy as np
import pytest
import torch

from app.slam.run import SlamRun, _Source
from perception.errors import InvalidInputError
from perception.io.detections import encode_detections
from perception.io.recordings.sequence import RgbdSequence
from perception.slam.system import FrameResult, Slam
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

FRAME = RgbdFrame(
    0.0,
    np.zeros((6, 8, 3), np.uint8),
    np.ones((6, 8), np.float32),
    CameraIntrinsics(8, 6, 8.0, 8.0, 4.0, 3.0),
)
FOUND = [ObjectDetection("mug", 1.0, np.ones((6, 8), bool))]


def read(number):
    if number == 1:
        raise InvalidInputError("frame 1 is damaged")
    return FRAME


SEQUENCE = RgbdSequence(Path("memory"), range(4), read)


@pytest.fixture
def run(monkeypatch):
    """A run whose second result is lost; torch's threads during processing are recorded."""
    slam, threads = object.__new__(Slam), []
    statuses = iter(("tracked", "lost", "weak"))

    def process(self, frame):
        threads.append(torch.get_num_threads())
        number = len(threads)
        seconds = {"track": 0.1 * number} | ({"joint": 1.0} if number == 1 else {})
        return FrameResult(number, float(number), np.eye(4), next(statuses), seconds=seconds)

    monkeypatch.setattr(Slam, "process", process)
    run = SlamRun(SEQUENCE, slam)
    run._source, run.threads = _Source(SEQUENCE, None, False), threads
    return run


def test_unreadable_frames_become_warnings(run):
    before = torch.get_num_threads()
    assert len(list(run.steps())) == 3 and run._source.number == 3
    assert len(run.warnings) == 1 and "frame 1 is damaged" in run.warnings[0]
    assert run.threads == [1, 1, 1] and torch.get_num_threads() == before


def test_the_trajectory_omits_lost_frames(run):
    list(run.steps())
    assert run.trajectory.times.tolist() == [1.0, 3.0]


def test_durations_and_rate(run):
    assert run.frame_rate == 0.0
    list(run.steps())
    assert run.seconds("joint") == [1.0] and run.seconds("track") == pytest.approx([0.1, 0.2, 0.3])
    assert run.frame_rate == pytest.approx(5.0)


def test_own_detections_precede_the_detector():
    entries = {0: encode_detections(0, FOUND)}
    source = _Source(RgbdSequence(Path("memory"), range(1), read, entries), lambda *args: [], True)
    assert [found.category for found in source(FRAME, SupportPlane())] == ["mug"]
    assert len(source.kept[0]) == 1
    detected = _Source(SEQUENCE, lambda *args: FOUND, False)
    assert detected(FRAME, SupportPlane()) == FOUND and detected.kept == {}
    with pytest.raises(InvalidInputError, match=r"memory has no detections\.json, and no detector is loaded"):
        _Source(SEQUENCE, None, False)(FRAME, SupportPlane())
