"""The Kalman filter of the camera motion in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import invert, se3_exp, se3_log
from perception.slam.motion import CameraMotion, CameraMotionConfig, adjoint, covariance_intersection

CONFIG = CameraMotionConfig(
    velocity_random_walk=(0.0, 0.6), velocity_sigma=(0.0, 0.3), pose_sigma=(1e-6, 1e-3)
)
NO_INFORMATION = np.zeros((6, 6))


@pytest.fixture
def motion(scenes):
    return CameraMotion.with_unknown_velocity(0.0, scenes.orbit((0, 0, 0), 0.5, 40, 30), CONFIG)


def test_the_initial_covariance_is_that_of_the_config_or_the_given_one(motion):
    expected = np.concatenate([np.full(3, 1e-12), np.full(3, 1e-6), np.zeros(3), np.full(3, 0.09)])
    np.testing.assert_allclose(motion.covariance, np.diag(expected))
    given = CameraMotion.with_unknown_velocity(1.0, np.eye(4), CONFIG, 4 * np.eye(6), 0.1)
    np.testing.assert_array_equal(given.pose_covariance, 4 * np.eye(6))
    assert given.period == 0.1 and given.position_std == pytest.approx(2.0)


def test_position_std_grows_by_velocity_and_white_acceleration(motion):
    std = motion.predict(0.2, CONFIG).position_std
    assert std == pytest.approx(np.sqrt(1e-3**2 + (0.3 * 0.2) ** 2 + 0.6**2 * 0.2**3 / 3), rel=1e-6)


def test_position_std_is_that_of_the_least_certain_direction(motion):
    P = np.array(motion.covariance)
    P[3:6, 3:6] = [[2.5, 1.5, 0], [1.5, 2.5, 0], [0, 0, 1]]
    assert replace(motion, covariance=P).position_std == pytest.approx(2.0)


def test_two_half_predictions_equal_one(motion):
    motion = replace(motion, velocity=np.array([0, 0, 0, 0.1, 0.2, -0.3]), period=0.1)
    once = motion.predict(0.1, CONFIG)
    twice = motion.predict(0.04, CONFIG).predict(0.1, CONFIG)
    np.testing.assert_allclose(once.T_world_camera, twice.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(once.covariance, twice.covariance, atol=1e-12)


def test_extrapolation_is_limited_in_time(motion):
    motion = replace(motion, velocity=np.array([0, 0, 0, 0.2, 0, 0]), period=1 / 30)
    there = motion.predict(10.0, CONFIG).T_world_camera
    moved = np.linalg.norm(there[:3, 3] - motion.T_world_camera[:3, 3])
    assert moved == pytest.approx(0.2 * CONFIG.max_periods / 30)


def test_a_prediction_into_the_past_does_not_move(motion):
    past = replace(motion, velocity=np.ones(6)).predict(-1.0, CONFIG)
    np.testing.assert_array_equal(past.T_world_camera, motion.T_world_camera)
    np.testing.assert_allclose(past.covariance, motion.covariance)


def test_the_period_is_that_of_the_first_two_frames(motion):
    assert motion.predict(0.1, CONFIG).predict(0.4, CONFIG).period == pytest.approx(0.1)


def test_the_update_adds_information_and_corrects_the_velocity(motion):
    predicted = motion.predict(0.1, CONFIG)
    step = np.array([0, 0, 0, 0.004, 0, 0])
    updated = predicted.update(predicted.T_world_camera @ se3_exp(step), 1e6 * np.eye(6))
    prior = predicted.covariance[3, 3]
    assert updated.covariance[3, 3] == pytest.approx(1 / (1 / prior + 1e6))
    gain = predicted.covariance[9, 3] / prior
    assert updated.velocity[3] == pytest.approx(gain * 0.004)
    both = np.ix_([3, 9], [3, 9])  # position and velocity along one axis
    H = np.array([[1.0, 0.0]])
    textbook = np.linalg.inv(np.linalg.inv(predicted.covariance[both]) + H.T @ H * 1e6)
    np.testing.assert_allclose(updated.covariance[both], textbook, rtol=1e-6)


def test_unobserved_directions_grow_uncertain_and_observed_ones_do_not(motion):
    information = np.diag([0, 0, 0, 1e6, 1e6, 0])  # nothing along the optical axis
    observed = blind = motion
    for k in range(1, 11):
        predicted = observed.predict(k / 30, CONFIG)
        observed = predicted.update(predicted.T_world_camera, information)
        predicted = blind.predict(k / 30, CONFIG)
        blind = predicted.update(predicted.T_world_camera, NO_INFORMATION)
    sigma = np.sqrt(np.diag(observed.pose_covariance)[3:])
    assert max(sigma[:2]) < 1.01e-3
    assert sigma[2] == pytest.approx(blind.position_std, rel=1e-6) and sigma[2] > 0.05


def test_a_correction_of_the_world_moves_the_pose_alone(motion):
    T = se3_exp(np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    moved = motion.transformed(T)
    np.testing.assert_allclose(moved.T_world_camera, T @ motion.T_world_camera)
    assert moved.covariance is motion.covariance and moved.velocity is motion.velocity


def test_the_adjoint_transforms_twists():
    rng = np.random.default_rng(3)
    T, xi = se3_exp(rng.normal(size=6)), rng.normal(0, 0.1, 6)
    np.testing.assert_allclose(se3_log(T @ se3_exp(xi) @ invert(T)), adjoint(T) @ xi, atol=1e-12)


def test_repeated_frames_do_not_reduce_the_uncertainty_of_correlated_errors(motion):
    """The filter averages, covariance intersection keeps the standard deviation of a single frame."""
    still = replace(motion, covariance=np.eye(12), correlated_covariance=np.eye(6))
    frozen = replace(CONFIG, velocity_random_walk=(0.0, 0.0))
    state = replace(still, covariance=np.diag(np.repeat([1.0, 0.0], 6)))
    for k in range(16):
        state = state.predict(k / 30, frozen).update(state.T_world_camera, 4.0 * np.eye(6))
    assert state.position_std == pytest.approx(1 / np.sqrt(1 + 16 * 4.0))
    assert state.correlated_position_std == pytest.approx(0.5, rel=0.02)


def test_covariance_intersection_keeps_the_better_of_two_and_bounds_any_correlation():
    sure, vague = np.diag([1.0, 1, 1, 0.01, 0.01, 0.01]), np.eye(6)
    fused = covariance_intersection(vague, np.linalg.inv(sure))
    assert np.sqrt(fused[3, 3]) == pytest.approx(0.1, rel=0.02)
    np.testing.assert_allclose(covariance_intersection(sure, np.linalg.inv(vague)), sure)
    np.testing.assert_allclose(covariance_intersection(sure, np.zeros((6, 6))), sure)
    along, across = np.diag([1.0, 1, 1, 0.01, 1, 1]), np.diag([1.0, 1, 1, 1, 0.01, 0.01])
    fused = covariance_intersection(along, np.linalg.inv(across))
    assert 0.01 < fused[3, 3] < 1 and 0.01 < fused[4, 4] < 1  # neither alone, nor the product of both
    for correlation in (-1.0, 0.0, 1.0):  # of the errors of both; a linear fusion with the same weight
        w = (fused[3, 3] ** -1 - 1) / (100 - 1)  # of `along`, from 1 / fused = 100 w + (1 - w)
        gain_a, gain_b = fused[3, 3] * w * 100, fused[3, 3] * (1 - w)
        true = gain_a**2 * 0.01 + gain_b**2 + 2 * correlation * gain_a * gain_b * 0.1
        assert fused[3, 3] >= true - 1e-12


def test_the_correlated_covariance_grows_with_the_prediction(motion):
    later = motion.predict(0.2, CONFIG)
    assert later.correlated_position_std == pytest.approx(later.position_std, rel=1e-6)
    assert motion.transformed(np.eye(4)).correlated_position_std == motion.correlated_position_std
