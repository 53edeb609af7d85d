"""Motion of the fingers over the range of the driven joints: order, passive joints, an unchanged model."""

import numpy as np
import pytest

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import hand_joints, is_below, sweep_hand
from tests.sim_assets.robots.conftest import JOINTS, SLIDING


def test_hand_joints_are_those_beyond_the_wrist(linkage_model):
    names = [linkage_model.joint(j).name for j in hand_joints(linkage_model, JOINTS)]
    assert names == ["left", "left_level", "right", "right_level"]


def test_is_below_follows_the_tree(sliding_model):
    body = {name: sliding_model.body(name).id for name in ("base", "wrist", "left")}
    assert is_below(sliding_model, body["left"], body["base"]) and is_below(
        sliding_model, body["left"], body["left"]
    )
    assert not is_below(sliding_model, body["wrist"], body["left"])


def test_sliding_fingers_go_from_closed_to_open_whatever_the_sign_of_their_ranges(sliding_model):
    sweep = sweep_hand(sliding_model, JOINTS, ("left", "right"))
    assert sweep.joint_names == ("left", "right") and sweep.n_driven == 2
    expected = np.linspace(0, 0.04, len(sweep.positions))
    np.testing.assert_allclose(sweep.positions, np.stack([expected, -expected], axis=1), atol=2e-5)


def test_an_equality_makes_the_passive_joints_of_a_linkage_follow(linkage_model):
    sweep = sweep_hand(linkage_model, JOINTS, ("left", "right"))
    left, right, left_level, right_level = sweep.positions.T
    assert sweep.joint_names[2:] == ("left_level", "right_level")
    np.testing.assert_allclose(left_level, -left, atol=0.01)
    np.testing.assert_allclose(right_level, -right, atol=0.01)
    assert left[0] == pytest.approx(0, abs=0.02) and left[-1] == pytest.approx(
        1, abs=0.02
    )  # cranks open outwards


def test_the_model_is_not_changed(sliding_model):
    sweep_hand(sliding_model, JOINTS, ("left", "right"))
    assert sliding_model.dof_frictionloss.max() == 20 and sliding_model.jnt_stiffness.max() == 0


def test_a_finger_without_a_range_is_named():
    model = mujoco.MjModel.from_xml_string(SLIDING.replace('range="0 .04"', 'limited="false"'))
    with pytest.raises(RobotFileError, match="finger joint 'left' needs a range"):
        sweep_hand(model, JOINTS, ("left", "right"))


def test_a_joint_alone_goes_exactly_through_its_range(jaw_model):
    sweep = sweep_hand(jaw_model, JOINTS, ("jaw",))
    assert sweep.joint_names == ("jaw",) and sweep.n_driven == 1
    np.testing.assert_allclose(sweep.positions[:, 0], np.linspace(0, 1.5, len(sweep.positions)))


def test_of_two_joints_with_unequal_ranges_the_commands_of_their_servos_count():
    servos = (
        '<position joint="left" kp="9" ctrlrange="0 .04"/><position joint="right" kp="9" ctrlrange="-.04 0"/>'
    )
    mjcf = SLIDING.replace('range="-.04 0"', 'range="-.04 .04"')
    sweep = sweep_hand(mujoco.MjModel.from_xml_string(mjcf), JOINTS, ("left", "right"))
    assert np.ptp(sweep.positions[:, 1]) == pytest.approx(0.08, abs=1e-4)
    mjcf = mjcf.replace("</mujoco>", f"<actuator>{servos}</actuator></mujoco>")
    sweep = sweep_hand(mujoco.MjModel.from_xml_string(mjcf), JOINTS, ("left", "right"))
    np.testing.assert_allclose(sweep.positions[:, 1], -sweep.positions[:, 0], atol=1e-4)
    assert np.ptp(sweep.positions[:, 1]) == pytest.approx(0.04, abs=1e-4)
