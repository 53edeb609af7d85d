"""The motion filter in closed form: growth of doubt, fusing, what a velocity learns, twists taken along."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import invert, se3_exp, se3_log
from perception.slam.motion import Motion, MotionConfig, adjoint

CONFIG = MotionConfig(wander=(0.0, 0.6), velocity=(0.0, 0.3), start=(1e-6, 1e-3))
BLIND = np.zeros((6, 6))


@pytest.fixture
def moving(scenes):
    """At rest as far as is known, somewhere."""
    return Motion.at(0.0, scenes.orbit((0, 0, 0), 0.5, 40, 30), CONFIG)


def test_doubt_grows_with_velocity_and_white_acceleration(moving):
    spread = moving.predicted(0.2, CONFIG).spread
    assert spread == pytest.approx(np.sqrt(1e-3**2 + (0.3 * 0.2) ** 2 + 0.6**2 * 0.2**3 / 3), rel=1e-6)


def test_two_halves_are_one_whole(moving):
    moving = replace(moving, velocity=np.array([0, 0, 0, 0.1, 0.2, -0.3]), period=0.1)
    whole = moving.predicted(0.1, CONFIG)
    halves = moving.predicted(0.04, CONFIG).predicted(0.1, CONFIG)
    np.testing.assert_allclose(whole.T_world_camera, halves.T_world_camera, atol=1e-12)
    np.testing.assert_allclose(whole.covariance, halves.covariance, atol=1e-12)


def test_a_motion_is_not_carried_on_for_ever(moving):
    velocity = np.array([0, 0, 0, 0.2, 0, 0])
    moving = replace(moving, velocity=velocity, period=1 / 30)
    there = moving.predicted(10.0, CONFIG).T_world_camera
    moved = np.linalg.norm(there[:3, 3] - moving.T_world_camera[:3, 3])
    assert moved == pytest.approx(0.2 * CONFIG.longest / 30)


def test_informations_add_and_the_velocity_learns_its_share(moving):
    predicted = moving.predicted(0.1, CONFIG)
    step = np.array([0, 0, 0, 0.004, 0, 0])
    told = predicted.told(predicted.T_world_camera @ se3_exp(step), 1e6 * np.eye(6))
    prior = predicted.covariance[3, 3]
    assert told.covariance[3, 3] == pytest.approx(1 / (1 / prior + 1e6))
    gain = predicted.covariance[9, 3] / prior
    assert told.velocity[3] == pytest.approx(gain * 0.004)
    joint = predicted.covariance[np.ix_([3, 9], [3, 9])]
    H = np.array([[1.0, 0.0]])  # the textbook's update of a place and its velocity
    textbook = np.linalg.inv(np.linalg.inv(joint) + H.T @ H * 1e6)
    np.testing.assert_allclose(told.covariance[np.ix_([3, 9], [3, 9])], textbook, rtol=1e-6)


def test_what_frames_do_not_see_grows_in_doubt_and_the_rest_does_not(moving):
    seen = np.diag([0, 0, 0, 1e6, 1e6, 0])  # nothing along the camera's axis
    motion = alone = moving
    for k in range(1, 11):
        predicted = motion.predicted(k / 30, CONFIG)
        motion = predicted.told(predicted.T_world_camera, seen)
        predicted = alone.predicted(k / 30, CONFIG)
        alone = predicted.told(predicted.T_world_camera, BLIND)
    sigma = np.sqrt(np.diag(motion.pose_covariance)[3:])
    assert max(sigma[:2]) < 1.01e-3
    assert sigma[2] == pytest.approx(alone.spread, rel=1e-6) and sigma[2] > 0.05


def test_twists_are_taken_along():
    rng = np.random.default_rng(3)
    T, xi = se3_exp(rng.normal(size=6)), rng.normal(0, 0.1, 6)
    np.testing.assert_allclose(se3_log(T @ se3_exp(xi) @ invert(T)), adjoint(T) @ xi, atol=1e-12)
