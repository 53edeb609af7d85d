"""The drive of the arm: it measures what the physics has, and its feedforward cancels inertia and damping."""

import numpy as np
import pytest

from sim_assets.cell.arm_drive import ArmDrive
from sim_assets.cell.scene import TIMESTEP, build_scene
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import panda
from sim_assets.robots.panda_arm import Q_READY


@pytest.fixture(scope="module")
def cell():
    robot = panda()
    model = build_scene((), [], None, np.random.default_rng(0), None, robot, ()).compile()
    return model, mujoco.MjData(model), robot


@pytest.fixture
def drive(cell):
    model, data, robot = cell
    mujoco.mj_resetData(model, data)
    drive = ArmDrive(model, data, robot)
    drive.reset()
    return drive


def step(cell, count):
    mujoco.mj_step(cell[0], cell[1], count)


def test_the_arm_starts_at_home_with_its_hand_open(drive):
    np.testing.assert_allclose(drive.joint_positions(), Q_READY)
    assert drive.gripper_width() == pytest.approx(0.08)
    assert np.abs(drive.joint_velocities()).max() == 0


def test_a_commanded_width_is_reached_and_full_force_closes(cell, drive):
    drive.command_width(0.05)
    step(cell, 500)
    assert drive.gripper_width() == pytest.approx(0.05, abs=5e-4)
    assert drive.finger_speed() < 1e-3
    drive.press()
    step(cell, 50)
    assert drive.finger_speed() > 0.01
    step(cell, 450)
    assert drive.gripper_width() == pytest.approx(0.0, abs=5e-4)


def test_feedforward_follows_a_constant_acceleration(cell, drive):
    """Half of a (t / 2) ** 2: without the feedforward of inertia and damping the lag would be 40 mrad."""
    acceleration = np.full(7, 1.5)
    count = 200
    for index in range(count):
        t = index * TIMESTEP
        drive.command_motion(Q_READY + 0.5 * acceleration * t**2, acceleration * t, acceleration)
        step(cell, 1)
    t = count * TIMESTEP
    np.testing.assert_allclose(drive.joint_positions(), Q_READY + 0.5 * acceleration * t**2, atol=3e-3)
    np.testing.assert_allclose(drive.joint_velocities(), acceleration * t, atol=2e-2)


def test_torque_limits_are_those_of_the_arm(drive):
    np.testing.assert_allclose(drive.torque_limits(), [87, 87, 87, 87, 12, 12, 12])


def test_a_joint_far_from_its_command_with_nothing_in_the_way(drive):
    assert drive.blocking_reason(2) == "the arm is blocked"
