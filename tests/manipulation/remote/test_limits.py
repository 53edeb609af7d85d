from dataclasses import replace

import numpy as np
import pytest

from manipulation.errors import RobotError
from manipulation.remote.limits import MotionLimits
from manipulation.robot import JointTrajectory
from manipulation.trajectories import JointLimits, MotionConfig, joint_move
from tests.manipulation.remote.conftest import a_move


@pytest.fixture(scope="module")
def limits(arm):
    return MotionLimits.of(arm)


def test_limits_are_those_of_the_model(arm, limits):
    assert limits.lower[3] == -3.0718 and limits.upper[5] == 3.7525
    np.testing.assert_array_equal(limits.velocity, arm.velocity_limit)


def test_planned_trajectories_keep_them(arm, limits):
    goal = np.array(arm.q_home) + np.array([0.8, 0.3, -0.5, 0.4, 0.2, -0.3, 1.0])
    limits.check(joint_move(arm.q_home, goal, JointLimits.of(arm, MotionConfig())), arm.q_home)


FAULTS = {
    "starts 0.100 rad from the measured position of joint2": lambda t: (t, 0.1 * np.eye(7)[1]),
    "too fast for joint1": lambda t: (replace(t, velocities=6 * t.velocities), 0),
    "too much for joint1": lambda t: (replace(t, accelerations=20 * t.accelerations), 0),
    "jumps at": lambda t: (
        replace(t, positions=np.where(np.arange(21)[:, None] == 9, 0.4, 0) + t.positions),
        0,
    ),
    "needs 7 columns": lambda t: (JointTrajectory(0.01, *[t.positions[:, :6]] * 3), 0),
    "not finite": lambda t: (replace(t, velocities=np.full((21, 7), np.inf)), 0),
    "takes": lambda t: (replace(t, period=10.0, velocities=0 * t.velocities), 0),
    "does not end at rest": lambda t: (replace(t, velocities=t.velocities + 0.1), 0),
}


@pytest.mark.parametrize("message", FAULTS)
def test_each_fault_is_named(arm, limits, message):
    trajectory, shift = FAULTS[message](a_move(arm))
    with pytest.raises(RobotError, match=message):
        limits.check(trajectory, arm.q_home + shift)


def test_the_range_of_each_joint_is_kept(arm, limits):
    for joint in range(7):
        beyond = limits.upper[joint] - arm.q_home[joint] + 0.01
        with pytest.raises(RobotError, match=rf"leaves by 0\.010 rad the range of joint{joint + 1}"):
            limits.check(a_move(arm, joint, beyond, samples=1201), arm.q_home)
