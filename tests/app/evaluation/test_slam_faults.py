"""Simulated faults of sensor and detector."""

from dataclasses import replace

import numpy as np
import pytest

from app.evaluation.slam_faults import flickering, held, with_fault
from perception.io.detections import encode_detections
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

CAMERA = CameraIntrinsics(8, 6, 8.0, 8.0, 4.0, 3.0)


@pytest.fixture
def frames():
    """Four seconds at 30 Hz."""
    rgb, depth = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 0.5, np.float32)
    return [RgbdFrame(k / 30, rgb, depth, CAMERA, np.eye(4)) for k in range(120)]


def test_a_sequence_in_memory_has_the_first_pose_only(frames):
    sequence = held(frames)
    read = list(sequence.frames())
    assert [number for number, _ in read] == list(range(120))
    assert read[0][1].T_world_camera is not None
    assert all(frame.T_world_camera is None for _, frame in read[1:])
    assert sequence.detections(3, frames[3]) is None
    found = encode_detections(3, [ObjectDetection("mug", 1.0, np.ones((6, 8), bool))])
    again = replace(sequence, entries={3: found}).detections(3, frames[3])
    assert again is not None and again[0].mask.all() and again[0].category == "mug"


def test_dropped_frames_leave_gaps(frames):
    ids = np.array(with_fault(frames, "dropped", np.random.default_rng(0)).ids)
    assert 70 < len(ids) < 110 and ids[0] == 0
    assert np.diff(ids).max() >= 6


def test_depth_is_missing_for_one_second(frames):
    sequence = with_fault(frames, "dark", np.random.default_rng(0))
    dark = [number for number in sequence.ids if not sequence.read(number).depth.any()]
    assert len(dark) == 30 and dark[0] == 48
    assert frames[48].depth.any()  # the given frames are unchanged


def test_masks_flicker():
    found = [ObjectDetection("mug", 1.0, np.ones((2, 2), bool))] * 1000
    assert 700 < len(flickering(found, np.random.default_rng(0))) < 800


def test_other_faults_leave_the_frames_unchanged(frames):
    for fault in ("none", "flicker", "moved"):
        assert list(with_fault(frames, fault, np.random.default_rng(0)).ids) == list(range(120))
