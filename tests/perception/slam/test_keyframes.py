"""Viewpoints, windows, and what a keyframe has in view."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import transform_points
from perception.slam.keyframes import (
    MIN_VIEW_ANGLE,
    Keyframe,
    is_new_viewpoint,
    select_window,
    view_angle,
)
from perception.types import ObjectDetection


@pytest.fixture(scope="module")
def view(observe, T_view):
    return observe(T_view)


@pytest.fixture
def keyframe(view, scenes):
    """Return a function that makes a keyframe at an azimuth in degrees."""

    def at(azimuth, number=0):
        T = scenes.orbit((0, 0.03, 0.03), 0.55, 45, azimuth)
        return Keyframe.of(replace(view, number=number).with_pose(T), np.eye(6))

    return at


def test_a_keyframe_keeps_frame_association_and_yaws_but_no_detections(view):
    p = np.array([0.25, 0.75])
    first, *others = view.detections
    detections = [ObjectDetection("mug", 0.9, first.mask, yaw_probabilities=p), *others]
    key = Keyframe.of(replace(view, number=7, detections=detections), 2 * np.eye(6))
    id = view.landmark_of[1]
    assert key.number == 7 and key.landmark_of == view.landmark_of and not hasattr(key, "detections")
    assert key.landmark_ids == set(view.landmark_of.values())
    assert list(key.yaw_probabilities) == [id]
    np.testing.assert_array_equal(key.mask(id), view.labels == 1)
    np.testing.assert_array_equal(key.covariance, 2 * np.eye(6))
    np.testing.assert_array_equal(key.observation(id).yaw_probabilities, p)
    assert key.observation(view.landmark_of[2]).yaw_probabilities.size == 0
    fewer = key.without_landmarks({id})
    assert fewer.landmark_ids == key.landmark_ids - {id} and id in key.landmark_ids


def test_an_observation_ignores_pixels_that_other_masks_may_occlude(view):
    """Pixels of the other masks count as background unless they are nearer than the object."""
    key = Keyframe.of(view, np.eye(6))
    for id in key.landmark_ids:
        seen = key.observation(id)
        assert seen.ignore is not None and not (seen.ignore & seen.mask).any()
    assert any(key.observation(id).ignore.any() for id in key.landmark_ids)
    alone = key.without_landmarks(set())
    label = next(label for label, id in key.landmark_of.items() if id == 0)
    alone = replace(alone, labels=np.where(alone.labels == label, alone.labels, 0).astype(np.uint8))
    assert alone.observation(0).ignore is None


def test_view_angle(scenes):
    Ts = [scenes.orbit((0, 0, 0), 0.5, 0, azimuth) for azimuth in (10, 35)]
    assert np.degrees(view_angle(np.zeros(3), *Ts)) == pytest.approx(25)
    assert view_angle(np.zeros(3), Ts[0], Ts[0]) == 0


def test_a_viewpoint_is_new_if_it_differs_from_those_of_all_keyframes(cylinders, keyframe):
    landmarks = cylinders.map().landmarks
    kept, near, far = [keyframe(20)], keyframe(24).T_world_camera, keyframe(60).T_world_camera
    assert not is_new_viewpoint(near, landmarks, kept)
    assert is_new_viewpoint(far, landmarks, kept)
    assert not is_new_viewpoint(far, landmarks, [*kept, keyframe(60, 1)])
    assert not is_new_viewpoint(far, {}, kept)
    blind = keyframe(60, 1).without_landmarks({0})  # does not observe landmark 0
    assert is_new_viewpoint(far, landmarks, [*kept, blind])
    assert np.degrees(MIN_VIEW_ANGLE) == pytest.approx(13)


def test_the_window_holds_the_nearest_keyframes_oldest_first(cylinders, keyframe):
    keys = [keyframe(azimuth, number) for number, azimuth in enumerate((20, 90, 45, 160, 35))]
    landmarks = cylinders.map().landmarks
    assert [key.number for key in select_window(keys[-1], keys, landmarks, 3)] == [0, 2, 4]
    assert [key.number for key in select_window(keys[-1], keys, landmarks, 2)] == [2, 4]
    # 30 degrees on five shared landmarks are nearer than 25 degrees on one
    shared = keyframe(50, 0), keyframe(45, 1).without_landmarks({1, 2, 3, 4}), keyframe(20, 2)
    assert [key.number for key in select_window(shared[-1], shared, landmarks, 2)] == [0, 2]


def test_keyframes_without_shared_landmarks_are_not_in_the_window(cylinders, keyframe):
    landmarks = cylinders.map().landmarks
    a, b = keyframe(20).without_landmarks({0, 1}), keyframe(20, 1).without_landmarks({2, 3, 4})
    assert select_window(b, [a, b], landmarks) == [b]
    retired = {id: landmark for id, landmark in landmarks.items() if id != 0}
    a = keyframe(20).without_landmarks({1, 2, 3, 4})
    assert select_window(keyframe(20, 1), [a], retired) != [a]


def test_points_in_view_project_inside_the_margin(view):
    key, k = Keyframe.of(view, np.eye(6)), view.frame.intrinsics
    u = np.array([1.0, 3.0, k.width - 4.0, 40, 40, 40, k.width - 2.0])
    v = np.array([40, 40, 40, k.height - 2.0, k.height - 4.0, 40, 40])
    depth = np.array([0.5, 0.5, 0.5, 0.5, 0.5, -0.5, 0.5])  # the sixth is behind the camera
    rays = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(7)], axis=1)
    points = transform_points(view.T_world_camera, rays * depth[:, None])
    assert key.has_in_view(points).tolist() == [False, True, True, False, True, False, False]
    assert key.has_in_view(points, 0.5).tolist() == [True, True, True, True, True, False, True]
