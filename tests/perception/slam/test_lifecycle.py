"""Counts of landmarks by frame, and their limits."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.association import RenderedMasks
from perception.slam.config import LandmarkLifecycleConfig
from perception.slam.lifecycle import has_failed, with_detections, with_visibility

LIFE = LandmarkLifecycleConfig()


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view, number=10)


@pytest.fixture
def landmarks(cylinders):
    return dict(cylinders.map().landmarks)


def rendering(visible, unoccluded):
    """Rendered masks that report numbers of pixels alone, at a pitch of four."""
    images = (np.full((60, 80), -1), np.zeros((60, 80)), np.zeros((60, 80)))
    return RenderedMasks(*images, unoccluded, visible, 4)


def test_detected_landmarks_get_hits_and_others_keep_their_counts(landmarks, view):
    updated = with_detections(landmarks, view.without_landmarks({0}), {}, 0.5)
    assert {id: x.n_hits for id, x in updated.items()} == {0: 1, 1: 2, 2: 2, 3: 2, 4: 2}


def test_labels_of_landmarks_that_are_gone_are_ignored(landmarks, view):
    del landmarks[0]
    assert set(with_detections(landmarks, view, {}, 0.5)) == {1, 2, 3, 4}


def test_outlier_frames_count_in_a_row_relative_to_the_best_landmark(landmarks, view):
    ratios = {0: 0.44, 1: 0.9, 2: 0.46, 3: 0.9, 4: 0.9}  # half of the best is 0.45
    for _ in range(2):
        landmarks = with_detections(landmarks, view, ratios, 0.5)
    assert [landmarks[id].n_outlier_frames for id in range(5)] == [2, 0, 0, 0, 0]
    assert with_detections(landmarks, view, {**ratios, 0: 0.8}, 0.5)[0].n_outlier_frames == 0


@pytest.mark.parametrize(
    ("n_visible", "n_unoccluded", "misses"),
    [(16, 16, 1), (15, 15, 0), (16, 26, 1), (16, 27, 0), (0, 40, 0)],
)
def test_only_large_and_open_landmarks_can_miss(landmarks, n_visible, n_unoccluded, misses):
    """240 image pixels at a pitch of four are 15 rendered ones; 60 % must be unoccluded."""
    rendered = rendering({0: n_visible}, {0: n_unoccluded})
    assert with_visibility(landmarks, rendered, {}, {1, 2}, LIFE)[0].n_misses == misses
    assert with_visibility(landmarks, rendered, {}, {0}, LIFE)[0].n_misses == 0


def test_absences_count_in_a_row(landmarks):
    at_limit, beyond = {0: LIFE.see_through_ratio}, {0: LIFE.see_through_ratio + 0.01}
    for _ in range(2):
        landmarks = with_visibility(landmarks, rendering({}, {}), beyond, set(), LIFE)
    assert [landmarks[id].n_see_through for id in range(5)] == [2, 0, 0, 0, 0]
    unjudged = with_visibility(landmarks, rendering({}, {}), {}, set(), LIFE)
    assert unjudged[0].n_see_through == 2
    assert with_visibility(landmarks, rendering({}, {}), at_limit, set(), LIFE)[0].n_see_through == 0


@pytest.mark.parametrize(
    "at_limit",
    [
        {"n_misses": LIFE.max_misses, "n_hits": 9},
        {"n_misses": 2, "n_hits": 2},
        {"n_outlier_frames": LIFE.max_outlier_frames},
        {"n_see_through": LIFE.max_see_through},
    ],
)
def test_landmarks_fail_beyond_each_limit(landmarks, at_limit):
    landmark = replace(landmarks[0], **at_limit)
    assert not has_failed(landmark, LIFE)
    name = next(iter(at_limit))
    assert has_failed(replace(landmark, **{name: at_limit[name] + 1}), LIFE)
