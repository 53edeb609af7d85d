"""Masks of a square on a plane, seen from straight above by cameras side by side."""

import numpy as np
import pytest

from perception.inference.agreement import agreed_masks
from perception.types import CameraIntrinsics, RgbdFrame, unclassified

CAMERA = CameraIntrinsics(200, 100, 100.0, 100.0, 99.5, 49.5)
ID, OTHER_ID = 4, 7
SQUARE = (-0.2, 0.2)  # [m] along both axes


def view(x):
    """An image of the plane z = 0 from 1 m above (x, 0), and the coordinates [m] that its pixels show."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = x, 0.0, 1.0
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    v, u = np.indices(depth.shape)
    frame = RgbdFrame(0.0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA, T)
    return frame, x + (u - CAMERA.cx) / CAMERA.fx, (CAMERA.cy - v) / CAMERA.fy


VIEWS = [view(x) for x in (-0.1, 0.0, 0.1, 0.2)]
FRAMES = [frame for frame, _, _ in VIEWS]


def mask_of(number, right=SQUARE[1]):
    """The mask of the square, or of a rectangle that goes farther to the right."""
    _, x, y = VIEWS[number]
    return (x > SQUARE[0]) & (x < right) & (y > SQUARE[0]) & (y < SQUARE[1])


def agreed(masks, frames=FRAMES, ids=(ID,)):
    rows = [[unclassified(mask, ID)] if mask is not None else [] for mask in masks]
    found = agreed_masks(frames, rows, ids)
    assert all(len(row) <= 1 and all(d.instance_id == ID for d in row) for row in found)
    return [row[0].mask if row else None for row in found]


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


def test_what_the_other_views_exclude_is_left_out():
    """A neighbour on the right was segmented with the square in one of four views."""
    masks = [mask_of(0), mask_of(1, right=0.4), mask_of(2), mask_of(3)]
    found = agreed(masks)
    assert iou(found[1], mask_of(1)) > 0.9
    for k in (0, 2, 3):
        np.testing.assert_array_equal(found[k], masks[k])


def test_what_most_views_include_stays():
    """The views that show less may have lost a part."""
    assert agreed([mask_of(0), *(mask_of(k, right=0.4) for k in (1, 2, 3))]) == [None] * 4


def test_a_few_pixels_at_the_border_are_noise():
    assert agreed([mask_of(0), mask_of(1, right=0.23), mask_of(2), mask_of(3)]) == [None] * 4


def test_views_that_do_not_see_a_point_do_not_vote():
    """Something else is in front of it there, or nothing was measured."""
    masks = [mask_of(0), mask_of(1, right=0.4), mask_of(2), mask_of(3)]
    for depth in (0.9, 0.0):
        frames = [
            frame if k < 2 else RgbdFrame(
                0.0, frame.rgb, np.where(x > 0.2, depth, 1.0).astype(np.float32), CAMERA, frame.T_world_camera
            )
            for k, (frame, x, _) in enumerate(VIEWS)
        ]  # fmt: skip
        assert agreed(masks, frames) == [None] * 4, "one vote is not enough"


@pytest.mark.parametrize(
    "masks", [[mask_of(0), mask_of(1, right=0.4)], [None, None, mask_of(2, 0.4), mask_of(3)]]
)
def test_two_views_are_too_few(masks):
    assert agreed(masks, FRAMES[: len(masks)]) == [None] * len(masks)


def test_a_view_of_which_hardly_anything_is_left_shows_something_else():
    _, x, y = VIEWS[1]
    beside = (x > 0.3) & (x < 0.6) & (np.abs(y) < 0.2)
    found = agreed([mask_of(0), beside, mask_of(2), mask_of(3)])
    assert found[1] is None and all(found[k] is not None for k in (0, 2, 3))


def test_only_the_given_instances_are_examined():
    assert agreed([mask_of(0), mask_of(1, right=0.4), mask_of(2), mask_of(3)], ids=(OTHER_ID,)) == [None] * 4
