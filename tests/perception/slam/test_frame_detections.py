"""Detections with the plane of the world, or with the one that the frame shows."""

import numpy as np
import pytest

from perception.errors import PerceptionError
from perception.io.recordings.sequence import without_pose
from perception.slam.frame_detections import detect_posed, detect_unposed
from perception.slam.mask_merging import MaskMergingConfig


@pytest.fixture
def looked(cylinders, T_view):
    frame, detections, _ = cylinders.look(T_view, noise=0.001)
    return frame, detections


def test_a_posed_frame_is_detected_with_the_given_plane(looked, cylinders):
    frame, detections = looked
    planes, plane = [], cylinders.plane

    def detect(frame, plane):
        planes.append(plane)
        return detections

    found = detect_posed(detect, frame, plane, MaskMergingConfig())
    assert len(found) == len(detections) and planes[0] is plane


def test_an_unposed_frame_is_detected_with_the_plane_in_its_own_coordinates(looked, cylinders):
    frame, detections = looked
    seen = []

    def detect(frame, plane):
        seen.append((frame, plane))
        return detections

    found = detect_unposed(detect, frame, MaskMergingConfig())
    ((shown, plane),) = seen
    assert len(found) == len(detections) and shown.T_world_camera is None
    T = frame.T_world_camera
    np.testing.assert_allclose(plane.normal, T[:3, :3].T @ cylinders.plane.normal, atol=0.01)


def test_without_a_plane_or_with_a_failing_detector_there_are_none(looked):
    frame, detections = looked

    def failing(frame, plane):
        raise PerceptionError("no network")

    assert detect_unposed(failing, frame, MaskMergingConfig()) == []
    dark = without_pose(frame)
    dark = type(dark)(dark.time, dark.rgb, np.zeros_like(dark.depth), dark.intrinsics)
    assert detect_unposed(lambda *_: detections, dark, MaskMergingConfig()) == []
