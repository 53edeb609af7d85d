"""Poses in the hand: shifted, not shifted, hardly seen, and the derivative of the motion with the hand."""

from dataclasses import replace

import numpy as np
import pytest

from perception.geometry import invert, rigid, se3_exp, so3_exp, so3_log
from perception.inference.held_pose import HeldConfig, object_by_hand, refit_held
from perception.rendering.pose import ObjectPose

DOWN = np.diag([1.0, -1.0, -1.0])  # orientation of a hand that points down


def held(mug, twist):
    """Return the mug after a twist in the frame of a hand at its rim, its pose before, and the TCP's."""
    before = mug.pose.T_world_object
    T_world_tcp = rigid(DOWN, mug.pose.translation + np.array([0.04, 0.0, 0.04]))
    after = T_world_tcp @ se3_exp(np.asarray(twist)) @ invert(T_world_tcp) @ before
    return replace(mug, pose=ObjectPose.of(after, mug.pose.scale)), before, T_world_tcp


def image(mug):
    return [mug.frame(mug.camera(1.2), np.random.default_rng(3))[0]]


@pytest.mark.parametrize(
    "twist",
    [
        (0.0, 0.0, 0.0, 0.009, 0.0, 0.0),
        (-0.16, 0.0, 0.0, 0.0, 0.0, 0.0),
        (0.1, 0.0, -0.08, -0.006, 0.0005, 0.002),
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
def test_what_has_shifted_between_the_pads_is_found(mug, estimate, twist):
    shifted, T_expected, T_world_tcp = held(mug, twist)
    check = refit_held(estimate, image(shifted), T_expected, T_world_tcp)
    assert check.status == "seen" and check.inlier_share > 0.85
    np.testing.assert_allclose(check.T_world_object[:3, 3], shifted.pose.translation, atol=0.0025)
    turn = so3_log(shifted.pose.rotation.T @ check.T_world_object[:3, :3])
    assert np.linalg.norm(turn) < np.deg2rad(2.5)


def test_each_deviation_applies_along_its_own_axis_of_the_hand(mug, estimate):
    """Without freedom across the pads and in turns, only the part of a shift along them is found."""
    shift = np.array([0.006, 0.006, 0.0])
    shifted, T_expected, T_world_tcp = held(mug, (0.0, 0.0, 0.0, *shift))
    config = HeldConfig(turn_sigma=(1e-4, 1e-4, 1e-4), shift_sigma=(0.008, 1e-4, 0.008))
    check = refit_held(estimate, image(shifted), T_expected, T_world_tcp, config=config)
    found = DOWN.T @ (check.T_world_object - T_expected)[:3, 3]
    assert abs(found[1]) < 5e-4 and 0.0025 < found[0] < 0.0065


def test_more_measurements_weigh_more_than_the_prior(mug, estimate):
    shifted, T_expected, T_world_tcp = held(mug, (-0.16, 0.0, 0.0, 0.0, 0.0, 0.0))
    errors = []
    for measurements in (1e-3, 20.0):
        config = HeldConfig(measurements=measurements)
        check = refit_held(estimate, image(shifted), T_expected, T_world_tcp, config=config)
        errors.append(np.linalg.norm(check.T_world_object[:3, 3] - shifted.pose.translation))
    assert errors[0] == pytest.approx(np.linalg.norm(T_expected[:3, 3] - shifted.pose.translation), abs=1e-3)
    assert errors[1] < 0.3 * errors[0]


def test_an_empty_hand_shows_nothing(mug, estimate):
    _, T_expected, T_world_tcp = held(mug, np.zeros(6))
    frames = [mug.frame(mug.camera(1.2), np.random.default_rng(3), False)[0]]
    assert refit_held(estimate, frames, T_expected, T_world_tcp).status == "not_there"
    unmeasured = replace(frames[0], depth=np.zeros_like(frames[0].depth))
    check = refit_held(estimate, [unmeasured], T_expected, T_world_tcp)
    assert check.status == "hidden" and check.shift == 0.0


def test_the_motion_of_an_object_with_the_hand(mug):
    rng = np.random.default_rng(0)
    T_hand = rigid(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    T_hand_object = rigid(so3_exp(rng.normal(size=3)), 0.1 * rng.normal(size=3))
    jacobian, step = object_by_hand(T_hand, T_hand_object), 1e-6
    before = T_hand @ T_hand_object
    for k in range(6):
        after = T_hand @ se3_exp(step * np.eye(6)[k]) @ T_hand_object
        turn, move = so3_log(before[:3, :3].T @ after[:3, :3]), after[:3, 3] - before[:3, 3]
        np.testing.assert_allclose(np.concatenate([turn, move]) / step, jacobian[:, k], atol=1e-5)
