"""Intervals between detections, and doubts relative to the first frame after one."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.detection_schedule import DetectionSchedule, DetectionScheduleConfig
from perception.slam.labelled_frame import LabelledFrame
from perception.slam.mask_tracking import TrackedMasks
from perception.types import CameraIntrinsics, RgbdFrame

RATIOS = {0: 0.9, 1: 0.8, 2: 0.3}  # landmark 2 is an outlier from the start
FRAME = RgbdFrame(
    0.0,
    np.zeros((4, 4, 3), np.uint8),
    np.zeros((4, 4), np.float32),
    CameraIntrinsics(4, 4, 4.0, 4.0, 1.5, 1.5),
)
MASKS = TrackedMasks(LabelledFrame.of(0, FRAME, []), {0: 1.0, 1: 0.5}, 1000)


@pytest.mark.parametrize(
    ("number", "urgent", "waiting", "due"),
    [(29, False, False, False), (30, False, False, True), (23, False, True, False), (24, False, True, True),
     (21, True, False, True)],
)  # fmt: skip
def test_detections_are_due_at_intervals_and_when_the_map_needs_them(number, urgent, waiting, due):
    schedule = DetectionSchedule()
    schedule.detected(20)
    assert schedule.is_due(number, urgent, waiting) == due


def test_an_interval_of_one_detects_in_every_frame():
    schedule = DetectionSchedule(DetectionScheduleConfig(max_interval=1))
    schedule.detected(4)
    assert schedule.is_due(5, urgent=False, waiting=False) and schedule.is_due(5, False, True)


def test_new_viewpoints_wait_for_a_few_frames():
    schedule = DetectionSchedule()
    schedule.detected(4)
    assert [schedule.allows_keyframe(number) for number in (5, 6, 7)] == [False, False, True]


@pytest.mark.parametrize(
    ("masks", "median", "ratios", "doubtful"),
    [
        (MASKS, 0.8, RATIOS, False),
        (replace(MASKS, n_unexplained=1600), 0.8, RATIOS, False),
        (replace(MASKS, n_unexplained=1601), 0.8, RATIOS, True),
        (replace(MASKS, explained={0: 0.61, 1: 0.31}), 0.8, RATIOS, False),
        (replace(MASKS, explained={0: 0.59, 1: 0.5}), 0.8, RATIOS, True),
        (replace(MASKS, explained={0: 1.0, 1: 0.29}), 0.8, RATIOS, True),
        (replace(MASKS, explained={0: 1.0, 5: 0.5}), 0.8, RATIOS, True),  # comes into view, but not measured
        (MASKS, 0.67, RATIOS, True),
        (MASKS, 0.8, RATIOS | {1: 0.44}, True),
    ],
)
def test_doubts_are_relative_to_the_first_frame(masks, median, ratios, doubtful):
    schedule = DetectionSchedule()
    assert not schedule.is_doubtful(MASKS, 0.8, RATIOS)
    assert schedule.is_doubtful(masks, median, ratios) == doubtful
    schedule.detected(3)
    assert not schedule.is_doubtful(masks, median, ratios)  # the new reference
