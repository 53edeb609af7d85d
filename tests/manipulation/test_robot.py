from dataclasses import replace

import numpy as np
import pytest

from manipulation.robot import (
    FingerMotion,
    GripperGeometry,
    HandInMotion,
    JointTrajectory,
    Robot,
    follow_opening,
)
from tests.manipulation.test_execution import FakeRobot


def test_duration_counts_the_intervals_between_samples():
    still = np.zeros((6, 7))
    assert JointTrajectory(0.002, still, still, still).duration == pytest.approx(0.01)


def test_a_part_of_a_trajectory_run_backwards():
    time = 0.1 * np.arange(11)[:, None]
    there = JointTrajectory(0.1, np.sin(time), np.cos(time), -np.sin(time))
    back = there.part(0, 7).reversed()
    assert back.duration == pytest.approx(0.6)
    np.testing.assert_array_equal(back.positions, there.positions[6::-1])
    np.testing.assert_allclose(
        np.gradient(back.positions[:, 0], 0.1)[1:-1], back.velocities[1:-1, 0], atol=2e-3
    )
    np.testing.assert_allclose(
        np.gradient(back.velocities[:, 0], 0.1)[1:-1], back.accelerations[1:-1, 0], atol=2e-3
    )


def test_largest_opening_is_that_of_the_gripper(arm):
    assert replace(arm, gripper=GripperGeometry(max_width=0.11)).max_width == 0.11


def test_objects_without_all_members_are_no_robots(arm):
    class Incomplete:
        def joint_positions(self):
            return arm.q_home

    assert not isinstance(Incomplete(), Robot)


def test_a_hand_that_cannot_open_in_motion_opens_before(arm):
    robot, still = FakeRobot(arm), np.array(arm.q_home)[None]
    motion = JointTrajectory(0.01, still, 0 * still, 0 * still)
    robot.follow = lambda trajectory: robot.motions.append((trajectory, robot.width))
    assert not isinstance(robot, HandInMotion)
    assert follow_opening(robot, motion, 0.03) == 0.03
    assert robot.motions == [(motion, 0.03)]


def test_a_hand_that_can_opens_in_motion(arm):
    robot, still = FakeRobot(arm), np.array(arm.q_home)[None]
    motion, calls = JointTrajectory(0.01, still, 0 * still, 0 * still), []
    robot.follow_opening = lambda *call: calls.append(call) or 0.029
    assert follow_opening(robot, motion, 0.03) == 0.029
    assert calls == [(motion, 0.03)] and not robot.motions and not robot.widths


def test_openings_and_joint_positions_of_sliding_fingers_are_inverse():
    fingers = FingerMotion.sliding(("l", "r"), 0.08)
    np.testing.assert_allclose(fingers.at(0.05), [0.025, 0.025])
    assert fingers.width(np.array([0.03, 0.02])) == pytest.approx(0.05)
    np.testing.assert_allclose(fingers.at(0.2), [0.04, 0.04])  # clipped


def test_a_linkage_is_tabulated_and_its_passive_joints_follow():
    positions = np.array([[0.8, -0.8, 0.1], [0.4, -0.4, 0.3], [0.0, 0.0, 0.2]])
    fingers = FingerMotion(("a", "b", "passive"), np.array([0.0, 0.05, 0.085]), positions, 2)
    np.testing.assert_allclose(fingers.at(0.025), [0.6, -0.6, 0.2])
    assert fingers.width(np.array([0.4, -0.4])) == pytest.approx(0.05)
    assert fingers.width(np.array([0.9, -0.9])) == 0.0


def test_the_middle_of_the_pads_moves_with_one_jaw_alone():
    assert GripperGeometry().pads_middle(0.04) == 0
    assert GripperGeometry(one_jaw=True).pads_middle(0.04) == 0.02
