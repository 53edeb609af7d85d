"""Label images and merged labels."""

from dataclasses import replace

import numpy as np
import pytest

from perception.slam.labelled_frame import LabelledFrame, label_image
from perception.types import CameraIntrinsics, ObjectDetection, RgbdFrame

CAMERA = CameraIntrinsics(8, 8, 8.0, 8.0, 3.5, 3.5)


@pytest.fixture
def view():
    rgb, depth = np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32)
    masks = [np.zeros((8, 8), bool) for _ in range(3)]
    masks[0][:2], masks[1][3:5], masks[2][6:] = True, True, True
    frame = RgbdFrame(0.5, rgb, depth, CAMERA)
    return LabelledFrame.of(4, frame, [ObjectDetection("mug", 1.0, mask) for mask in masks])


def test_labels_count_detections_from_one(view):
    assert view.number == 4 and view.labels[:, 0].tolist() == [1, 1, 0, 2, 2, 0, 3, 3]
    assert view.landmark_of == {}


def test_smaller_masks_cover_larger_ones():
    large, small = np.zeros((8, 8), bool), np.zeros((8, 8), bool)
    large[1:7, 1:7], small[3:5, 3:5] = True, True
    for masks, at_small in (((small, large), 1), ((large, small), 2)):
        labels = label_image([ObjectDetection("mug", 1.0, mask) for mask in masks], (8, 8))
        assert labels[4, 4] == at_small and labels[1, 1] == 3 - at_small and labels[0, 0] == 0


def test_masks_of_one_landmark_get_the_first_label(view):
    merged = view.associated({1: 7, 2: 9, 3: 7})
    assert merged.labels[:, 0].tolist() == [1, 1, 0, 2, 2, 0, 1, 1]
    assert merged.landmark_of == {1: 7, 2: 9} and merged.landmark_ids == {7, 9}
    assert view.labels[7, 0] == 3


def test_without_landmarks_keeps_the_labels(view):
    fewer = view.associated({1: 7, 2: 9}).without_landmarks({7})
    assert fewer.landmark_of == {2: 9} and fewer.labels[0, 0] == 1


def test_with_pose_replaces_the_pose_alone(view):
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    posed = view.with_pose(T)
    np.testing.assert_array_equal(posed.T_world_camera, T)
    assert posed.frame.time == 0.5 and posed.labels is view.labels and view.frame.T_world_camera is None
    with pytest.raises(AssertionError):
        _ = replace(view).T_world_camera
