"""Tests of the timing of motions with a carried object."""

import numpy as np
import pytest

from manipulation.carrying import MAX_TORQUE, carrying_moves, inertial_torque, slower
from manipulation.kinematics import Kinematics
from manipulation.robot import ArmDescription
from manipulation.trajectories import JointLimits, MotionConfig, concatenate, joint_move, joint_path

HANGING = np.array([0.0, 0.0, 0.11])  # centre of a bottle held by its neck, in the frame of the TCP


@pytest.fixture(scope="module")
def kinematics(arm: ArmDescription) -> Kinematics:
    return Kinematics(arm)


@pytest.fixture(scope="module")
def limits(kinematics: Kinematics) -> JointLimits:
    return JointLimits.of(kinematics.arm, MotionConfig())


def turned(kinematics: Kinematics, angle: float) -> np.ndarray:
    """The home posture turned about the vertical axis of the base."""
    q = kinematics.arm.q_home.copy()
    q[0] += angle
    return q


def test_torque_of_a_turn_about_the_base_is_the_closed_form(
    kinematics: Kinematics, limits: JointLimits
) -> None:
    move = joint_move(turned(kinematics, -1.2), turned(kinematics, 1.2), limits)
    T = kinematics.forward(move.positions[0])
    lever = T[:3, :3] @ HANGING  # straight down: the hand points down at home
    radius = np.linalg.norm((T[:3, 3] + lever)[:2])
    tangential, radial = move.accelerations[:, 0] * radius, move.velocities[:, 0] ** 2 * radius
    expected = (abs(lever[2]) * np.hypot(tangential, radial)).max()
    assert inertial_torque(kinematics, move, HANGING) == pytest.approx(expected, rel=0.03)


def test_a_motion_without_a_lever_exerts_no_torque(kinematics: Kinematics, limits: JointLimits) -> None:
    move = joint_move(turned(kinematics, -1.2), turned(kinematics, 1.2), limits)
    assert inertial_torque(kinematics, move, np.zeros(3)) == 0.0


def test_a_fast_move_is_slowed_down_to_the_limit(kinematics: Kinematics, limits: JointLimits) -> None:
    waypoints = [turned(kinematics, angle) for angle in (-1.2, 1.2, 1.1)]
    fast = joint_path(waypoints, limits)
    assert inertial_torque(kinematics, fast, HANGING) > 1.2 * MAX_TORQUE
    carried = concatenate(carrying_moves(kinematics, waypoints, HANGING, limits))
    assert inertial_torque(kinematics, carried, HANGING) == pytest.approx(MAX_TORQUE, rel=0.05)
    np.testing.assert_allclose(carried.positions[[0, -1]], fast.positions[[0, -1]], atol=1e-9)


def test_what_is_held_at_its_centre_is_carried_at_full_speed(
    kinematics: Kinematics, limits: JointLimits
) -> None:
    waypoints = [turned(kinematics, angle) for angle in (-1.2, 1.2)]
    (carried,) = carrying_moves(kinematics, waypoints, np.array([0.0, 0.0, 0.01]), limits)
    np.testing.assert_array_equal(carried.positions, joint_path(waypoints, limits).positions)


def test_slower_limits_stretch_a_move_in_time(kinematics: Kinematics, limits: JointLimits) -> None:
    q, goal = turned(kinematics, 0.0), turned(kinematics, 0.8)
    fast, slow = joint_move(q, goal, limits), joint_move(q, goal, slower(limits, 1.5))
    assert slow.duration == pytest.approx(1.5 * fast.duration, abs=0.004)
