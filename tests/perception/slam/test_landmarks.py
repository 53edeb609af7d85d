"""Landmarks: bounding radius, votes, covariance, duplicates; the stack of a map."""

from dataclasses import replace

import numpy as np
import pytest

from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose
from perception.slam.landmarks import (
    bounding_radius,
    coincide,
    duplicates,
    fit_covariance,
    log_probabilities,
    origin_distance,
)
from perception.types import CATEGORIES, ObjectDetection

MASK = np.ones((2, 2), bool)


@pytest.fixture
def landmark(cylinders):
    return cylinders.landmark(1)


def placed(landmark, shift):
    pose = landmark.state.pose
    pose = ObjectPose(pose.rotation, pose.translation + shift, pose.scale)
    return landmark.with_state(FitState(pose, landmark.state.code))


def test_the_bounding_radius_holds_the_occupied_voxels_and_one_more(landmark):
    """A single voxel at index (31, 16, 16): centre (31, 1, 1)/32, plus 2.5 half voxels on each axis."""
    grid = np.zeros((32, 32, 32))
    grid[31, 16, 16] = 0.06
    shape = replace_grid(landmark.shape, grid)
    state = FitState(ObjectPose(np.eye(3), np.zeros(3), np.array([0.1, 0.2, 0.3])), np.zeros(16))
    expected = np.linalg.norm((np.array([31, 1, 1]) / 32 + 2.5 / 32) * [0.1, 0.2, 0.3])
    assert bounding_radius(shape, state) == pytest.approx(expected)
    empty = replace_grid(landmark.shape, np.full((32, 32, 32), 0.05))
    assert bounding_radius(empty, state) == pytest.approx(np.linalg.norm([0.1, 0.2, 0.3]))


def replace_grid(shape, grid):
    return type("Shape", (type(shape),), {"__init__": lambda self: setattr(self, "grid", grid)})()


def test_a_new_state_changes_the_bounding_radius(landmark):
    pose = landmark.state.pose
    double = FitState(ObjectPose(pose.rotation, pose.translation, 2 * pose.scale), landmark.state.code)
    assert landmark.with_state(double).bounding_radius == pytest.approx(2 * landmark.bounding_radius)


def test_the_sample_distance_is_a_share_of_the_largest_voxel(landmark):
    expected = 0.5 * 2 * landmark.state.pose.scale.max() / 32
    assert landmark.sample_distance == pytest.approx(expected)


def test_detections_add_votes_and_hits_and_clear_misses(landmark):
    p = np.array([0.7, 0.1, 0.1, 0.1])
    found = ObjectDetection("mug", 0.7, MASK, class_probabilities=p)
    after = replace(landmark, n_misses=3).with_detection(found)
    np.testing.assert_allclose(after.log_votes, landmark.log_votes + np.log(p))
    assert (after.n_hits, after.n_misses) == (2, 0)


def test_votes_decide_the_most_likely_class(landmark):
    votes = np.zeros(4)
    votes[CATEGORIES.index("bowl")], votes[CATEGORIES.index("can")] = 2.0, 1.5
    voted = replace(landmark, log_votes=votes)
    assert voted.most_likely_category == "bowl" and voted.class_log_odds == pytest.approx(0.5)
    assert replace(voted, category="bowl").class_log_odds == 0


def test_log_probabilities_are_bounded_and_default_to_the_score():
    p = np.array([0.999, 0.001, 0.0, 0.0])
    found = ObjectDetection("mug", 0.9, MASK, class_probabilities=p)
    np.testing.assert_allclose(np.exp(log_probabilities(found)), [0.999, 0.01, 0.01, 0.01])
    plain = np.exp(log_probabilities(ObjectDetection("can", 0.7, MASK)))
    assert plain[CATEGORIES.index("can")] == pytest.approx(0.7)
    assert sorted(plain)[:3] == pytest.approx([0.1, 0.1, 0.1])


def test_the_covariance_of_a_fit_is_larger_for_truncated_masks():
    np.testing.assert_allclose(np.sqrt(np.diag(fit_covariance(False))), [np.radians(1.5)] * 3 + [0.0025] * 3)
    np.testing.assert_allclose(np.sqrt(np.diag(fit_covariance(True))), [np.radians(3.0)] * 3 + [0.006] * 3)


def test_the_covariance_of_the_camera_is_propagated_to_the_landmark(landmark, T_view):
    translation = np.diag([0, 0, 0, 4e-6, 4e-6, 4e-6])
    own = fit_covariance(False)
    assert landmark.covariance_from(T_view, translation) - own == pytest.approx(translation)
    rotation = np.diag([1e-4, 1e-4, 1e-4, 0, 0, 0])
    added = landmark.covariance_from(T_view, rotation) - own
    away = np.linalg.norm(landmark.state.pose.translation - T_view[:3, 3])
    assert np.trace(added[3:, 3:]) == pytest.approx(2e-4 * away**2)  # two of three axes have a lever
    truncated = replace(landmark, truncated=True)
    assert truncated.covariance_from(T_view, translation) == pytest.approx(fit_covariance(True) + translation)


def test_landmarks_coincide_within_a_share_of_their_bounding_radii(landmark):
    limit = 0.35 * 2 * landmark.bounding_radius
    near, far = (placed(landmark, np.array([0.0, factor * limit, 0.0])) for factor in (0.99, 1.01))
    assert coincide(landmark, near) and not coincide(landmark, far)
    assert origin_distance(landmark, far) == pytest.approx(1.01 * limit)


def test_of_coinciding_landmarks_the_one_with_most_hits_is_kept(cylinders):
    landmarks = dict(cylinders.map().landmarks)
    assert duplicates(landmarks) == set()
    landmarks[7] = replace(landmarks[1], id=7, n_hits=5)
    assert duplicates(landmarks) == {1}
    landmarks[7] = replace(landmarks[7], n_hits=1)  # as many: the older one stays
    assert duplicates(landmarks) == {7}


def test_a_duplicate_does_not_displace_others(landmark):
    """B coincides with A, C with B alone: only B goes."""
    limit = 0.35 * 2 * landmark.bounding_radius
    row = [
        replace(placed(landmark, np.array([0.0, 0.8 * k * limit, 0.0])), id=k, n_hits=9 - k) for k in range(3)
    ]
    assert duplicates({x.id: x for x in row}) == {1}


def test_the_stack_is_rebuilt_only_when_a_shape_changes(cylinders):
    world = cylinders.map()
    stack = world.stack
    landmark = world.landmarks[2]
    assert world.with_landmarks(placed(landmark, np.full(3, 0.1))).stack is stack
    state = FitState(landmark.state.pose, landmark.state.code + 0.1)
    assert world.with_landmarks(landmark.with_state(state)).stack is not stack
    assert world.with_landmarks(replace(landmark, id=9)).stack is not stack
    fewer = world.without({2})
    assert fewer.ids == (0, 1, 3, 4) and fewer.stack is not stack and world.ids == (0, 1, 2, 3, 4)
