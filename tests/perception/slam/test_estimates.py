"""Object estimates of landmarks."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from perception.inference.problem import FitState
from perception.rendering.pose import ObjectPose
from perception.slam.estimates import object_estimate, object_estimates
from perception.slam.landmarks import LandmarkMap


def test_an_estimate_has_the_pose_shape_and_statistics_of_its_landmark(cylinders):
    landmark = replace(cylinders.landmark(1), n_hits=6, residual=0.002)
    estimate = object_estimate(landmark, cylinders.decoder)
    pose = landmark.state.pose
    assert (estimate.id, estimate.category, estimate.n_views, estimate.residual) == (1, "can", 6, 0.002)
    np.testing.assert_array_equal(estimate.T_world_object, pose.T_world_object)
    np.testing.assert_array_equal(estimate.scale, pose.scale)
    np.testing.assert_array_equal(estimate.code, landmark.state.code)
    extent = np.ptp(estimate.mesh_world.vertices, axis=0)
    np.testing.assert_allclose(extent[:2], 2 * 0.036, atol=0.004)


def test_the_score_is_the_posterior_of_the_class(cylinders):
    votes = np.log([0.1, 0.1, 0.1, 0.7]) - 500.0  # many views: no underflow
    landmark = replace(cylinders.landmark(0), log_votes=votes)
    assert object_estimate(landmark, cylinders.decoder).score == pytest.approx(0.7)


def test_landmarks_without_surface_are_skipped_with_a_warning(cylinders, caplog):
    world = cylinders.map()
    code = np.zeros(16)
    code[0] = -20.0  # no radius
    landmark = world.landmarks[2]
    pose = landmark.state.pose
    empty = replace(landmark, state=FitState(ObjectPose(pose.rotation, pose.translation, pose.scale), code))
    world = LandmarkMap(world.plane, {**world.landmarks, 2: empty})
    with caplog.at_level(logging.WARNING):
        estimates = object_estimates(world, cylinders.decoder)
    assert [estimate.id for estimate in estimates] == [0, 1, 3, 4]
    assert "landmark 2 skipped" in caplog.text
