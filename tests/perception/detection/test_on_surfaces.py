"""Detection on several surfaces with stubs for the networks."""

from dataclasses import replace

import numpy as np
import pytest

from perception.detection.left_out import LeftOut
from perception.detection.on_surfaces import (
    assigned,
    classified,
    examine_frame,
    placed,
    raised_masks,
    supports_of,
    unrecognised,
    with_one_support,
)
from perception.support.surface import SupportSurface
from perception.types import ObjectDetection, SupportPlane

TABLE = SupportSurface(SupportPlane(), np.array([[-0.6, -0.5], [0.6, -0.5], [0.6, 0.6], [-0.6, 0.6]]))
TOP = SupportSurface(
    SupportPlane(offset=0.1), np.array([[-0.18, -0.13], [0.18, -0.13], [0.18, 0.13], [-0.18, 0.13]])
)
BOTH = (TABLE, TOP)


@pytest.fixture(scope="module")
def view(scenes):
    """A box (0), a can on it (1) and a can beside it (2)."""
    solids = [
        scenes.Solid(0, 0, 0.1, half=(0.18, 0.13)),
        scenes.Solid(0.05, 0, 0.1, radius=0.033, bottom=0.1),
        scenes.Solid(0.3, 0, 0.1, radius=0.033),
    ]
    return scenes.render(solids, scenes.look_at((0, -0.6, 0.5), (0, 0, 0.05)), 0.001, (640, 480))


def cans(view, *numbers, score=0.9):
    return [ObjectDetection("can", score, view.instances == k) for k in numbers]


class Examiner:
    """Finds given objects on each surface."""

    def __init__(self, *found, left_out=()):
        self.found, self.left_out, self.asked = found, list(left_out), []

    def __call__(self, frame, plane):
        raise AssertionError("a detector that examines surfaces is not called")

    def examine(self, frame, surfaces, support=0):
        self.asked.append(support)
        return [replace(d, support=support) for d in self.found[support]], self.left_out


def test_each_surface_is_examined(view):
    detector = Examiner(cans(view, 2), cans(view, 1))
    found, left_out = examine_frame(view.frame, detector, BOTH)
    assert detector.asked == [0, 1] and not left_out
    assert [d.support for d in found] == [0, 1]


def test_surfaces_with_nothing_on_them_are_not_examined(view):
    bare = SupportSurface(SupportPlane(offset=0.6), TOP.outline)
    detector = Examiner(cans(view, 2), [])
    examine_frame(view.frame, detector, (TABLE, bare))
    assert detector.asked == [0]


def test_what_is_no_thing_on_another_surface_is_left_out(view):
    wall = np.zeros_like(view.instances, bool)
    wall[:, :30] = True
    found, left_out = examine_frame(view.frame, Examiner([], [ObjectDetection("bottle", 0.9, wall)]), BOTH)
    assert not found and [c.reason for c in left_out] == ["cut by the image border"]


def test_an_object_found_on_two_surfaces_is_one(view):
    detector = Examiner(cans(view, 1, score=0.6), cans(view, 1, score=0.8))
    ((only,), _) = examine_frame(view.frame, detector, BOTH)
    assert (only.support, only.score) == (1, 0.8)


def test_a_candidate_that_became_an_object_is_not_left_out(view):
    same = LeftOut(view.instances == 2, "of none of the classes")
    other = LeftOut(view.instances == 0, "of none of the classes")
    _, left_out = examine_frame(view.frame, Examiner(cans(view, 2), [], left_out=[same, other]), (TABLE,))
    assert left_out == [other]


def test_detections_of_any_detector_are_placed(view):
    detections = cans(view, 1, 2)
    found, left_out = examine_frame(view.frame, lambda frame, plane: detections, BOTH)
    assert [d.support for d in found] == [1, 0] and not left_out
    beside = (replace(TABLE, outline=TOP.outline), TOP)
    found, left_out = placed(view.frame, cans(view, 2), beside)
    assert not found and left_out[0].reason == "beyond the edge of the support surface"


def test_given_masks_are_assigned_and_classified_by_their_surface(view):
    masks = [view.instances == k for k in (2, 1, 0)]
    assert supports_of(view.frame, masks, BOTH) == [0, 1, 0]
    assert supports_of(view.frame, masks, (TABLE,)) == [0, 0, 0]
    asked = []

    def classify(frame, plane, there):
        asked.append((plane, len(there)))
        return [ObjectDetection("can", 0.9, mask) for mask in there]

    found = classified(view.frame, masks, BOTH, classify)
    assert asked == [(TABLE.plane, 2), (TOP.plane, 1)] and [d.support for d in found] == [0, 0, 1]
    assert [d.support for d in assigned(view.frame, cans(view, 2, 1), BOTH)] == [0, 1]


def test_an_instance_has_the_surface_of_most_views(view):
    (can,) = cans(view, 1)
    rows = [[replace(can, instance_id=5, support=s)] for s in (1, 0, 1)] + [[can]]
    assert [row[0].support for row in with_one_support(rows)] == [1, 1, 1, 0]


def test_things_in_depth_are_found_without_a_network(view):
    masks = raised_masks(view.frame, TABLE)
    assert len(masks) == 2  # the box with its can, and the other can
    can = view.instances == 2
    assert max((mask & can).sum() / (mask | can).sum() for mask in masks) > 0.6
    known = LeftOut(view.instances == 0, "of none of the classes")
    (thing,) = unrecognised(view.frame, (TABLE,), [known])
    assert thing.reason == "not recognised as an object" and (thing.mask & can).sum() > 0.5 * can.sum()
