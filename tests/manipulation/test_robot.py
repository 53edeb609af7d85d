from dataclasses import replace

import numpy as np
import pytest

from manipulation.robot import GripperGeometry, JointTrajectory, Robot


def test_duration_counts_the_intervals_between_samples():
    still = np.zeros((6, 7))
    assert JointTrajectory(0.002, still, still, still).duration == pytest.approx(0.01)


def test_largest_opening_is_that_of_the_gripper(arm):
    assert replace(arm, gripper=GripperGeometry(max_width=0.11)).max_width == 0.11


def test_objects_without_all_members_are_no_robots(arm):
    class Incomplete:
        def joint_positions(self):
            return arm.q_home

    assert not isinstance(Incomplete(), Robot)
