"""Candidates of no class become detections that all classes share, with ids after those of the objects."""

from dataclasses import replace

import numpy as np
import pytest

from perception.detection.left_out import LeftOut, of_no_class
from perception.detection.unclassified import MAX_HEIGHT, associate_unclassified, is_low
from perception.types import (
    CameraIntrinsics,
    ObjectDetection,
    RgbdFrame,
    SupportPlane,
    is_unclassified,
    unclassified,
)

PLANE = SupportPlane()


def from_above(*masks, height=0.1):
    """A view from 0.5 m above the table; masked pixels are at a height above it."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.5, -0.2, 0.5
    depth = np.full((120, 160), 0.5, np.float32)
    for mask in masks:
        depth[mask] = 0.5 - height
    camera = CameraIntrinsics(160, 120, 150.0, 150.0, 79.5, 59.5)
    return RgbdFrame(0.0, np.zeros((120, 160, 3), np.uint8), depth, camera, T)


def square(left, size=20):
    mask = np.zeros((120, 160), np.bool_)
    mask[50 : 50 + size, left : left + size] = True
    return mask


def associate(views, known=None):
    """Associate candidates, given as masks of each view."""
    frames = [from_above(*masks) for masks in views]
    left_out = [of_no_class(mask, 0.9, frame) for frame, masks in enumerate(views) for mask in masks]
    return associate_unclassified(frames, known or [()] * len(views), left_out, PLANE)


def test_one_candidate_has_one_id_in_all_views_and_no_class():
    rows = associate([[square(30), square(100)], [square(100), square(30)]])
    assert [len(row) for row in rows] == [2, 2]
    assert all(is_unclassified(found) for row in rows for found in row)
    for row in rows:
        left = {found.instance_id: int(found.mask.any(axis=0).argmax()) for found in row}
        assert sorted(left) == [0, 1] and sorted(left.values()) == [30, 100]
    assert {f.instance_id for f in rows[0] if f.mask[50, 30]} == {
        f.instance_id for f in rows[1] if f.mask[50, 30]
    }


def test_ids_continue_those_of_the_objects_which_are_no_candidates():
    found = ObjectDetection("can", 0.9, square(30), instance_id=4)
    rows = associate([[square(31), square(100)]] * 2, known=[(found,)] * 2)
    assert [[f.instance_id for f in row] for row in rows] == [[5], [5]]
    assert all(f.mask[50, 110] for row in rows for f in row)


def test_parts_of_objects_and_mergers_of_them_are_no_candidates():
    found = ObjectDetection("can", 0.9, square(30, 30), instance_id=0)
    for mask in (square(32, 8), square(10, 60)):
        assert associate([[mask]] * 2, known=[(found,)] * 2) == [[], []]


def test_one_view_of_several_is_not_enough_and_one_of_one_is():
    assert associate([[square(30)], []]) == [[], []]
    assert [len(row) for row in associate([[square(30)]])] == [1]


def test_candidates_left_out_for_other_reasons_stay_out():
    frames = [from_above(square(30))]
    left_out = [LeftOut(square(30), "too small")]
    assert associate_unclassified(frames, [()], left_out, PLANE) == [[]]


def test_what_was_judged_before_is_no_candidate():
    masks = [square(30), square(100)]
    left_out = [replace(of_no_class(m, 0.9, k), was_judged=m is masks[0]) for k in (0, 1) for m in masks]
    rows = associate_unclassified([from_above(*masks)] * 2, [()] * 2, left_out, PLANE)
    assert [[bool(f.mask[50, 110]) for f in row] for row in rows] == [[True], [True]]


@pytest.mark.parametrize(("n_judged", "n_views"), [(1, 3), (2, 0), (3, 0)])
def test_what_was_judged_in_half_of_its_views_is_no_candidate_and_else_has_all_its_views(n_judged, n_views):
    mask = square(30)
    left_out = [replace(of_no_class(mask.copy(), 0.9, k), was_judged=k < n_judged) for k in range(3)]
    rows = associate_unclassified([from_above(mask)] * 3, [()] * 3, left_out, PLANE)
    assert sum(len(row) for row in rows) == n_views


def test_what_most_views_show_as_high_does_not_lie():
    low, high = MAX_HEIGHT - 0.01, MAX_HEIGHT + 0.01
    rows = [[unclassified(square(30), 3)]] * 3
    for heights, expected in (((low, low, high), True), ((low, high, high), False)):
        frames = [from_above(square(30), height=height) for height in heights]
        assert is_low(frames, rows, 3, PLANE) == expected
    assert not is_low(frames, rows, 4, PLANE)
