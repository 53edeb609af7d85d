"""Gripper commands, and the contact parameters on which grasps depend."""

import pytest

from sim_assets.robots import load_robot, panda
from sim_assets.robots.panda_arm import FINGER_FORCE, FULL_CLOSE, GRIPPER_GAIN, MAX_WIDTH
from sim_assets.robots.simulated_arm import ARM_CONTACT, PAD_CONTACT


@pytest.mark.parametrize("name", ["panda", "sixaxis"])
def test_gripper_command_is_linear_between_closed_and_open(name):
    arm = load_robot(name)
    width, (closed, opened) = arm.description.max_width, arm.commands[[0, -1]]
    assert arm.gripper_command(0.0) == pytest.approx(closed)
    assert arm.gripper_command(width) == pytest.approx(opened)
    assert arm.gripper_command(width / 4) == pytest.approx(0.75 * closed + 0.25 * opened)


def test_contact_parameters_are_those_of_rubber_pads_and_an_arm_that_passes_through_itself():
    assert PAD_CONTACT["friction"] == (1.0, 0.01, 0.0005)  # sliding, torsional [m], rolling [m]
    assert (PAD_CONTACT["condim"], PAD_CONTACT["priority"], PAD_CONTACT["solref"]) == (4, 1, (0.004, 1))
    assert not ARM_CONTACT["contype"] & ARM_CONTACT["conaffinity"]


def test_panda_gripper_has_the_published_opening_and_force():
    assert (MAX_WIDTH, FINGER_FORCE) == (0.08, 70.0)
    assert panda().press == FULL_CLOSE and GRIPPER_GAIN * -FULL_CLOSE >= 2 * FINGER_FORCE
