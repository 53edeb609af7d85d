"""What the reconstruction accepts keeps its class, what it rejects or never saw is 'other'."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.evaluation import detection_fits
from app.evaluation.detection_scoring import is_accepted
from perception.inference.acceptance import shipped_acceptance
from perception.pipeline import load_decoder
from perception.types import OTHER, CameraIntrinsics, ObjectDetection, RgbdFrame, SupportPlane

QUARTER_TURN = np.diag([0.0, 0.0, 1.0, 1.0]) + np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0] * 4, [0] * 4])
CAMERA = CameraIntrinsics(2, 2, 1.0, 1.0, 0.5, 0.5)
FRAME = RgbdFrame(0.0, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), np.float32), CAMERA)


def detection(category: str, *probabilities: float) -> ObjectDetection:
    return ObjectDetection(
        category, max(probabilities), np.ones((2, 2), bool), class_probabilities=np.array(probabilities)
    )


def test_the_reconstruction_decides(monkeypatch) -> None:
    found = [
        detection("mug", 0.9, 0.05, 0.0, 0.0, 0.05),
        detection("bottle", 0.0, 0.0, 0.6, 0.3, 0.1),  # fits better as a can
        detection("can", 0.0, 0.0, 0.1, 0.8, 0.1),  # rejected
        detection("bowl", 0.0, 0.05, 0.0, 0.0, 0.95),  # too improbable to be tried
        detection("mug", 0.9, 0.05, 0.0, 0.0, 0.05),  # the shaft of a shoe
    ]
    tried = []

    def reconstruct(frames, rows, *_, options):
        tried.extend(d.instance_id for d in rows[0])
        assert options.acceptance is shipped_acceptance()
        return [
            SimpleNamespace(id=0, category="mug", score=0.7, T_world_object=QUARTER_TURN),
            SimpleNamespace(id=1, category="can", score=0.6, T_world_object=np.eye(4)),
            SimpleNamespace(id=4, category="mug", score=0.9, T_world_object=np.eye(4)),
        ]

    def parts_of_things(estimates, frames, rows, planes):
        assert [e.id for e in estimates] == [0, 1, 4] and len(frames) == len(rows) == len(planes) == 1
        return {4}

    monkeypatch.setattr(detection_fits, "reconstruct", reconstruct)
    monkeypatch.setattr(detection_fits, "parts_of_things_in_one_view", parts_of_things)
    judged, yaws = detection_fits.judged_by_fits(
        FRAME, found, SupportPlane(), load_decoder("cpu"), shipped_acceptance()
    )
    assert tried == [0, 1, 2, None, 4]
    assert [is_accepted(d) for d in judged] == [True, True, False, False, False]
    assert yaws == [pytest.approx(np.pi / 2), 0.0, None, None, None]
    assert [(d.category, d.score) for d in judged[:2]] == [("mug", 0.7), ("can", 0.6)]
    assert all(d.class_probabilities.argmax() == OTHER for d in judged[2:])
