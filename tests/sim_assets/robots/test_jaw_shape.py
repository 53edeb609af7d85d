"""A hand with one turning jaw against its construction: opening, tool frame, jaws and palm."""

import numpy as np
import pytest

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import sweep_hand
from sim_assets.robots.hand_shape import measure_hand
from sim_assets.robots.jaw_shape import one_moves
from tests.sim_assets.robots.conftest import JOINTS, one_jaw


def measure(mjcf):
    model = mujoco.MjModel.from_xml_string(mjcf)
    return measure_hand(model, JOINTS, sweep_hand(model, JOINTS, ("jaw",)))


@pytest.fixture(scope="module")
def hand():
    return measure(one_jaw())


def test_one_joint_moves_the_hand(jaw_model, sliding_model):
    assert one_moves(sweep_hand(jaw_model, JOINTS, ("jaw",)))
    assert not one_moves(sweep_hand(sliding_model, JOINTS, ("left", "right")))


def test_the_tool_frame_is_on_the_fixed_pad_with_y_towards_the_jaw(hand):
    assert hand.body == "wrist"
    np.testing.assert_allclose(hand.T_body_tcp[:3, 3], [0.11 - 0.0095, 0, 0], atol=1e-4)
    np.testing.assert_allclose(hand.T_body_tcp[:3, 1:3], [[0, 1], [1, 0], [0, 0]], atol=1e-6)
    assert np.linalg.det(hand.T_body_tcp[:3, :3]) == pytest.approx(1)


def test_the_opening_is_that_20_mm_above_the_tool_frame(hand):
    """There the jaw is narrowest: 0.0705 tan q, with points up to 4 mm apart on its face."""
    q, width = hand.fingers.positions[1:, 0], hand.fingers.widths[1:]
    lever = width / np.tan(q)
    assert ((lever > 0.0704) & (lever < 0.0755)).all()
    assert hand.fingers.n_driven == 1 and (np.diff(width) > 0).all()


def test_the_jaw_is_used_until_its_tip_has_risen_by_15_mm(hand):
    """It is at x = 0.01 + 0.1 cos q."""
    q = hand.fingers.positions[-1, 0]
    assert np.arccos(0.85) - 0.03 < q < np.arccos(0.85) + 0.01
    assert hand.geometry.max_width == pytest.approx(hand.fingers.widths[-1])


def test_dimensions_for_planning(hand):
    shape = hand.geometry
    assert shape.one_jaw and shape.min_width == 0
    assert shape.tip == pytest.approx(0.0095, abs=1e-3)  # the corner of the turning jaw passes the fixed tip
    assert shape.finger_half_width == pytest.approx(0.008, abs=1e-4)
    assert shape.palm == pytest.approx(0.1005 - 0.02, abs=1e-3)
    assert shape.pads_middle(0.04) == pytest.approx(0.02)


@pytest.mark.parametrize("axis", ["0 0 -1", "0 0 1"])
def test_whatever_the_sense_of_the_joint(axis):
    sign = 1 if axis == "0 0 1" else -1
    limits = "0 1.5" if sign > 0 else "-1.5 0"
    mjcf = one_jaw().replace(
        'name="jaw" axis="0 0 1" range="0 1.5"', f'name="jaw" axis="{axis}" range="{limits}"'
    )
    found = measure(mjcf)
    assert np.sign(found.fingers.positions[-1, 0]) == sign
    np.testing.assert_allclose(found.T_body_tcp[:3, 1], (0, 1, 0), atol=1e-6)


def test_a_sliding_jaw_opens_with_its_joint():
    mjcf = one_jaw().replace(
        'name="jaw" axis="0 0 1" range="0 1.5"', 'name="jaw" type="slide" axis="0 1 0" range="0 .06"'
    )
    found = measure(mjcf)
    np.testing.assert_allclose(found.fingers.widths, found.fingers.positions[:, 0], atol=1e-4)
    np.testing.assert_allclose(found.T_body_tcp[:3, 1:3], [[0, 1], [1, 0], [0, 0]], atol=1e-6)


def test_a_joint_that_opens_nothing_is_refused():
    with pytest.raises(RobotFileError, match=r"the jaw opens from 0\.0 to .* mm only"):
        measure(one_jaw().replace('range="0 1.5"', 'range="0 0.02"'))
