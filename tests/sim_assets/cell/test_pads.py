"""The opening of a linkage hand from its pads: as by its drivers without load, true where it bends."""

import numpy as np
import pytest

from sim_assets.cell.pads import pad_points
from sim_assets.rendering.headless import mujoco
from sim_assets.robots import load_robot
from tests.sim_assets.robots.conftest import linkage
from tests.sim_assets.robots.conftest import write as write  # the fixture


@pytest.fixture
def hand(write):
    arm = load_robot(str(write(linkage()))).description
    model = mujoco.MjModel.from_xml_string(arm.mjcf)
    model.geom_contype[:] = 1
    return arm, model


def opening(arm, model, positions):
    data = mujoco.MjData(model)
    for name, value in zip(arm.fingers.joint_names, positions, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    return pad_points(model, arm).opening(data)


def test_without_load_the_drivers_tell_the_opening(hand):
    arm, model = hand
    for width in (0.0, 0.02, 0.05):
        wanted = max(width, arm.gripper.min_width)
        assert opening(arm, model, arm.fingers.at(width)) == pytest.approx(wanted, abs=5e-4)


def test_a_pad_that_tilts_is_farther_than_its_driver_tells(hand):
    arm, model = hand
    bent = arm.fingers.at(0.02)
    bent[2] += 0.1 * np.sign(bent[2] or 1.0)
    assert abs(opening(arm, model, bent) - 0.02) > 5e-4


def test_sliding_fingers_need_no_pads(write):
    arm = load_robot(str(write())).description
    assert pad_points(mujoco.MjModel.from_xml_string(arm.mjcf), arm) is None
