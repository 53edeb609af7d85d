"""Actions: encoding is the inverse of decoding; ranges."""

from functools import cache

import numpy as np
import pytest

from app.environments.actions import MAX_SHIFT, MAX_TURN, JointActions, TcpActions, codec_of
from manipulation.kinematics import Kinematics
from sim_assets.robots import panda


@cache
def kinematics():
    return Kinematics(panda().description)


@pytest.fixture
def home():
    return np.array(kinematics().arm.q_home)


@pytest.mark.parametrize("control", ["joint", "tcp"])
def test_encoded_targets_are_reached(control, home):
    codec = codec_of(control, kinematics())
    target = home + 0.03
    action = codec.encode(target, 0.05, home)
    assert action.dtype == np.float32 and codec.space.contains(action) and len(codec.names) == len(action)
    q, width = codec.decode(action, home)
    np.testing.assert_allclose(kinematics().forward(q), kinematics().forward(target), atol=2e-3)
    assert width == pytest.approx(0.05)
    assert codec.deviation(q, target) < 2e-3 < codec.deviation(home, target)


def test_joint_actions_are_limited_to_the_joints(home):
    codec = JointActions(kinematics())
    np.testing.assert_allclose(codec.space.low[:-1], kinematics().lower, rtol=1e-6)
    assert codec.space.contains(codec.encode(home + 10, 1.0, home))
    assert codec.names[0] == "joint1" and codec.names[-1] == "gripper_width"


def test_a_zero_change_of_the_tool_keeps_the_posture(home):
    codec = TcpActions(kinematics())
    q, width = codec.decode(np.array([0, 0, 0, 0, 0, 0, 0.02], np.float32), home)
    assert q is home and width == pytest.approx(0.02)


def test_a_translation_of_the_tool_is_in_the_world_frame(home):
    q, _ = TcpActions(kinematics()).decode(np.array([0, 0.03, 0, 0, 0, 0, 0.02], np.float32), home)
    change = kinematics().forward(q) - kinematics().forward(home)
    np.testing.assert_allclose(change[:3, 3], (0, 0.03, 0), atol=2e-4)
    np.testing.assert_allclose(change[:3, :3], 0, atol=2e-3)


def test_an_unreachable_pose_keeps_the_posture(home):
    codec = TcpActions(kinematics())
    stretched = home.copy()
    stretched[[1, 3]] = 1.4, -0.12
    q, _ = codec.decode(np.array([MAX_SHIFT, 0, 0, 0, 0, 0, 0.0], np.float32), stretched)
    np.testing.assert_array_equal(q, stretched)


def test_large_changes_are_clipped(home):
    action = TcpActions(kinematics()).encode(home + 1.0, 0.0, home)
    assert np.abs(action[:3]).max() <= np.float32(MAX_SHIFT) and np.abs(action[3:6]).max() <= MAX_TURN
