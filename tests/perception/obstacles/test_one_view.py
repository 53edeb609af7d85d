"""Which objects are asked about, and what may be another object."""

import numpy as np
import pytest

from perception.obstacles import one_view
from perception.obstacles.one_view import parts_of_things_in_one_view
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    ObjectEstimate,
    RgbdFrame,
    SupportPlane,
    TriangleMesh,
)

CAMERA = CameraIntrinsics(4, 1, 1.0, 1.0, 0.5, 0.5)
FRAME = RgbdFrame(0.0, np.zeros((1, 4, 3), np.uint8), np.ones((1, 4), np.float32), CAMERA)
MUG, NONE = (0.9, 0.0, 0.0, 0.0, 0.1), (0.2, 0.0, 0.0, 0.1, 0.7)
PLANES = (SupportPlane(), SupportPlane(offset=0.1))


def seen(id, pixel, probabilities=MUG, support=0):
    mask = np.arange(4)[None] == pixel
    p = np.array(probabilities)
    return ObjectDetection("mug", 0.9, mask, instance_id=id, class_probabilities=p, support=support)


def estimated(id, n_views=1):
    mesh = TriangleMesh(np.eye(3), np.arange(3)[None])
    return ObjectEstimate(id, "mug", np.zeros(16), np.eye(4), np.ones(3), mesh, n_views=n_views)


@pytest.fixture
def asked(monkeypatch):
    """Calls of ``continued_in_one_view``: ids asked about, height of the plane, occupied pixels."""
    calls = []

    def continued(objects, known, view, plane, occupied):
        calls.append(([e.id for e in objects], plane.offset, np.flatnonzero(occupied[0]).tolist()))
        assert [e.id for e in known] == [0, 1, 2]
        return {objects[0].id}

    monkeypatch.setattr(one_view, "continued_in_one_view", continued)
    monkeypatch.setattr(one_view, "clean_frame", lambda frame: frame)
    return calls


def test_objects_seen_once_are_asked_about_on_their_planes(asked):
    objects = [estimated(0), estimated(1, n_views=2), estimated(2)]
    rows = [[seen(0, 0), seen(1, 1)], [seen(1, 1), seen(2, 2, support=1)]]
    assert parts_of_things_in_one_view(objects, [FRAME, FRAME], rows, PLANES) == {0, 2}
    assert asked == [([0], 0.0, []), ([2], 0.1, [])]


def test_detections_that_were_left_out_occupy_their_pixels_if_they_may_be_objects(asked):
    objects = [estimated(0), estimated(1, 2), estimated(2, 2)]
    rows = [[seen(0, 0), seen(7, 1), seen(8, 2, NONE), seen(None, 3)]]
    assert parts_of_things_in_one_view(objects, [FRAME], rows, PLANES) == {0}
    assert asked == [([0], 0.0, [1, 3])]


def test_a_given_class_is_kept(asked):
    objects = [estimated(0), estimated(1), estimated(2)]
    rows = [[seen(0, 0, ()), seen(1, 1, ()), seen(2, 2, ())]]
    assert parts_of_things_in_one_view(objects, [FRAME], rows, PLANES) == set()
    assert not asked
