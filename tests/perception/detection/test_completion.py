"""Detections of other sources get what they lack: classes from one network, yaws from the other."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from perception.detection.completion import complete_detections, is_complete, posed_detections
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    RgbdFrame,
    SupportPlane,
    is_unclassified,
    unclassified,
)

PLANES = (SupportPlane(), SupportPlane(offset=0.05))
CAMERA = CameraIntrinsics(5, 4, 5.0, 5.0, 2.0, 1.5)
FRAME = RgbdFrame(0.0, np.zeros((4, 5, 3), np.uint8), np.ones((4, 5), np.float32), CAMERA)
YAW = np.full(36, 1 / 36)


class Recorder:
    """Completes with class probabilities by the area of the mask, and remembers the planes."""

    def __init__(self, answers):
        self.answers, self.planes = answers, []

    def complete(self, frame, plane, detections):
        self.planes.append(plane)
        result = []
        for d in detections:
            p = self.answers[int(d.mask.sum())] if is_unclassified(d) else d.class_probabilities
            result.append(
                ObjectDetection(d.category, d.score, d.mask, np.asarray(p), YAW, d.instance_id, d.support)
            )
        return result


def mask(area):
    image = np.zeros((4, 5), bool)
    image.flat[:area] = True
    return image


def test_only_incomplete_detections_reach_the_networks_each_with_its_plane():
    bowl = ObjectDetection("bowl", 0.7, mask(1), instance_id=1)
    mug = ObjectDetection("mug", 0.7, mask(2), instance_id=2, support=1)
    known = ObjectDetection("mug", 0.7, mask(3), yaw_probabilities=YAW, instance_id=3)
    detector = Recorder({})
    ((first, second, third), empty) = complete_detections(
        [FRAME, FRAME], [[bowl, mug, known], []], PLANES, detector
    )
    assert first is bowl and third is known and empty == ()
    assert second.category == "mug" and second.score == 0.7 and len(second.yaw_probabilities) == 36
    assert detector.planes == [PLANES[1]]
    assert all(map(is_complete, (first, second, third)))


def test_views_of_an_unclassified_object_agree_on_a_class(caplog):
    answers = {
        1: [0.5, 0.4, 0.03, 0.03, 0.04],  # rather a mug
        2: [0.05, 0.9, 0.02, 0.02, 0.01],  # clearly a bowl
        3: [0.05, 0.05, 0.05, 0.05, 0.8],  # nothing of the classes
    }
    per_frame = [
        [unclassified(mask(1), 4), unclassified(mask(3), 5)],
        [unclassified(mask(2), 4), unclassified(mask(3), 5)],
    ]
    with caplog.at_level(logging.WARNING):
        completed = complete_detections([FRAME, FRAME], per_frame, PLANES, Recorder(answers))
    assert [[d.category for d in row] for row in completed] == [["bowl"], ["bowl"]]
    expected = 0.4 * 0.9 / (0.5 * 0.05 + 0.4 * 0.9 + 0.03 * 0.02 * 2 + 0.04 * 0.01)
    assert completed[0][0].score == completed[1][0].score == pytest.approx(expected, rel=1e-6)
    assert "object 5 is left out" in caplog.text


def test_without_ids_the_association_decides():
    ((found,),) = complete_detections(
        [FRAME], [[unclassified(mask(3))]], PLANES, Recorder({3: [0.05, 0.05, 0.05, 0.05, 0.8]})
    )
    assert found.class_probabilities[4] == 0.8 and found.instance_id is None


def test_poses_are_asked_for_on_the_plane_of_each_detection():
    class Namer(Recorder):
        def posed(self, frame, plane, detections):
            self.planes.append((plane.offset, len(detections)))
            return [replace(d, pose_probabilities=np.full(10, plane.offset)) for d in detections]

    row = [ObjectDetection("can", 0.9, mask(3 + k), instance_id=k, support=k % 2) for k in range(3)]
    namer = Namer({})
    ((a, b, c),) = posed_detections([FRAME], [row], [SupportPlane(), SupportPlane(offset=0.3)], namer)
    assert [d.instance_id for d in (a, b, c)] == [0, 1, 2]
    assert [d.pose_probabilities[0] for d in (a, b, c)] == [0.0, 0.3, 0.0]
    assert namer.planes == [(0.0, 2), (0.3, 1)]
