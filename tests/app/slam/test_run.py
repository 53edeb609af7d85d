"""A run on a sequence: unreadable frames, durations, trajectory and the source of detections."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from app.slam.run import SlamRun, _Source
from perception.errors import InvalidInputError
from perception.io.detections import encode_detections
from perception.io.recordings.sequence import RgbdSequence
from perception.slam.config import SlamConfig
from perception.slam.frame_result import FrameResult
from perception.slam.system import Slam
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

FRAME = RgbdFrame(
    0.0,
    np.zeros((6, 8, 3), np.uint8),
    np.ones((6, 8), np.float32),
    CameraIntrinsics(8, 6, 8.0, 8.0, 4.0, 3.0),
)
FOUND = [ObjectDetection("mug", 1.0, np.ones((6, 8), bool))]


class Undecoded:
    """A shape prior that is not used."""

    def __call__(self, category, code):
        raise AssertionError

    def with_jacobian(self, category, code, threads=1):
        raise AssertionError


def read(number):
    if number == 1:
        raise InvalidInputError("frame 1 is damaged")
    return FRAME


SEQUENCE = RgbdSequence(Path("memory"), range(4), read)


@pytest.fixture
def run(monkeypatch):
    """A run whose second result is lost; torch's threads during processing are recorded."""
    slam, threads, finished = object.__new__(Slam), [], []
    statuses = iter(("tracked", "lost", "weak"))

    def process(self, frame):
        threads.append(torch.get_num_threads())
        number = len(threads)
        seconds = {"track": 0.1 * number} | ({"joint": 1.0} if number == 1 else {})
        return FrameResult(number, float(number), np.eye(4), next(statuses), seconds=seconds)

    monkeypatch.setattr(Slam, "process", process)
    monkeypatch.setattr(Slam, "finish", lambda self: finished.append(len(threads)))
    run = SlamRun(SEQUENCE, slam)
    run._source, run.threads = _Source(SEQUENCE, None), threads
    run.finished = finished
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
    assert run.frame_rate == run.loop_rate == 0.0
    list(run.steps())
    assert run.seconds("joint") == [1.0] and run.seconds("track") == pytest.approx([0.1, 0.2, 0.3])
    assert run.frame_rate == pytest.approx(5.0) and run.loop_rate == pytest.approx(3 / 1.6)
    assert run.finished == [3]


def test_own_detections_precede_the_detector():
    entries = {0: encode_detections(0, FOUND)}
    source = _Source(RgbdSequence(Path("memory"), range(1), read, entries), lambda *args: [])
    assert [found.category for found in source(FRAME, SupportPlane())] == ["mug"]
    detected = _Source(SEQUENCE, lambda *args: FOUND)
    assert detected(FRAME, SupportPlane()) == FOUND
    with pytest.raises(InvalidInputError, match=r"memory has no detections\.json, and no detector is loaded"):
        _Source(SEQUENCE, None)(FRAME, SupportPlane())


@pytest.mark.parametrize(("entries", "interval"), [({}, 1), (None, SlamConfig().detection.max_interval)])
def test_own_detections_are_used_in_every_frame(entries, interval):
    run = SlamRun.start(replace(SEQUENCE, entries=entries), Undecoded(), None, SlamConfig())
    assert run.slam.config.detection.max_interval == interval
