"""Ages of masks without a landmark, and when they are due."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.config import LandmarkLifecycleConfig
from perception.slam.unmatched_masks import UnmatchedMask, updated_masks

LIFE = LandmarkLifecycleConfig()


@pytest.fixture(scope="module")
def partial(observe, T_view):
    """Frame 10, whose first label has no landmark."""
    view = observe(T_view, number=10)
    return view.without_landmarks({view.landmark_of[1]})


def rectangle(pixels, truncated=False):
    mask = np.zeros((240, 320), bool)
    rows, columns = np.divmod(np.arange(pixels), 100)
    mask[(0 if truncated else 1) + rows, 1 + columns] = True
    return mask


def test_masks_count_successive_frames_by_overlap(partial):
    once = updated_masks({}, partial)
    twice = updated_masks(once, partial)
    assert {label: mask.n_frames for label, mask in twice.items()} == {1: 2}
    elsewhere = {1: UnmatchedMask(np.roll(partial.labels == 1, 100, 1), 7)}
    assert updated_masks(elsewhere, partial)[1].n_frames == 1


def test_a_mask_keeps_its_last_attempt(partial):
    before = {k: UnmatchedMask(partial.detections[0].mask, k, tried) for k, tried in enumerate((3, None, 5))}
    assert (updated_masks(before, partial)[1].n_frames, updated_masks(before, partial)[1].tried) == (3, 5)


def test_masks_that_were_merged_into_another_label_are_dropped(partial):
    merged = replace(partial, labels=np.where(partial.labels == 1, 0, partial.labels))
    assert updated_masks({}, merged) == {}


@pytest.mark.parametrize(
    ("n_frames", "tried", "due"),
    [(1, None, False), (2, None, True), (3, 9, False), (9, 3, False), (9, 2, True)],
)
def test_masks_wait_and_are_retried_at_intervals(n_frames, tried, due):
    """The frame has number 10, the interval is 8."""
    mask = rectangle(500)
    assert UnmatchedMask(mask, n_frames, tried).is_due(mask, 10, True, LIFE) == due


@pytest.mark.parametrize(
    ("pixels", "truncated", "supported", "due"),
    [
        (119, False, True, False),
        (120, False, True, True),
        (399, True, False, False),
        (400, True, False, True),
        (400, True, True, False),
    ],
)
def test_small_and_truncated_masks(pixels, truncated, supported, due):
    mask = rectangle(pixels, truncated)
    assert UnmatchedMask(mask, 2).is_due(mask, 10, supported, LIFE) == due
