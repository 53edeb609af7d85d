"""Measured hands against their construction: opening, tool frame, fingers and palm."""

import numpy as np
import pytest

from sim_assets.errors import RobotFileError
from sim_assets.rendering.headless import mujoco
from sim_assets.robots.finger_motion import sweep_hand
from sim_assets.robots.hand_shape import measure_hand
from tests.sim_assets.robots.conftest import JOINTS, SLIDING, linkage


def measure(model, driven=("left", "right")):
    return measure_hand(model, JOINTS, sweep_hand(model, JOINTS, driven))


def test_sliding_hand(sliding_model):
    hand = measure(sliding_model)
    shape = hand.geometry
    assert hand.body == "wrist"
    assert shape.max_width == pytest.approx(0.082, abs=1e-4) and shape.min_width == pytest.approx(
        0.002, abs=1e-4
    )
    # The fingertips are at x = 0.11; of the long pads the last 19 mm count.
    np.testing.assert_allclose(hand.T_body_tcp[:3, 3], [0.11 - 0.0095, 0, 0], atol=1e-4)
    np.testing.assert_allclose(hand.T_body_tcp[:3, 2], [1, 0, 0], atol=1e-6)
    assert abs(hand.T_body_tcp[1, 1]) == pytest.approx(1, abs=1e-6)
    assert np.linalg.det(hand.T_body_tcp[:3, :3]) == pytest.approx(1)
    assert shape.tip == pytest.approx(0.0095, abs=1e-4) and shape.pad_half_height == 0.0095
    assert shape.finger_thickness == pytest.approx(0.01, abs=2e-4)
    assert shape.finger_half_width == pytest.approx(0.008, abs=2e-4)
    assert shape.palm == pytest.approx(0.1005 - 0.02, abs=3e-3)
    assert (shape.palm_half_length, shape.palm_half_width) == pytest.approx((0.06, 0.03), abs=1e-3)


def test_openings_of_sliding_fingers_are_linear(sliding_model):
    fingers = measure(sliding_model).fingers
    np.testing.assert_allclose(fingers.widths, 0.002 + 2 * fingers.positions[:, 0], atol=1e-4)
    assert fingers.width(fingers.at(0.05)) == pytest.approx(0.05, abs=1e-6)


def test_opening_of_a_linkage_is_that_of_its_cranks(linkage_model):
    """Pads at y = 0.01 + 0.04 sin q - 0.01: parallel to themselves, opening 0.08 sin q."""
    fingers = measure(linkage_model).fingers
    np.testing.assert_allclose(fingers.widths, 0.08 * np.sin(fingers.positions[:, 0]), atol=8e-4)
    assert fingers.n_driven == 2 and (np.diff(fingers.widths) > 0).all()


def test_a_linkage_lengthens_as_it_closes(linkage_model):
    shape = measure(linkage_model).geometry
    travel = 0.04 * (1 - np.cos(1.0))  # of the tips along the approach; the tool frame is in its middle
    assert shape.tip == pytest.approx(shape.pad_half_height + travel / 2, abs=1.5e-3)


def test_pads_that_overlap_in_the_closed_hand_open_from_zero():
    mjcf = SLIDING.replace('pos=".06 .006 0"', 'pos=".06 .001 0"').replace(
        'pos=".06 -.006 0"', 'pos=".06 -.001 0"'
    )
    fingers = measure(mujoco.MjModel.from_xml_string(mjcf)).fingers
    assert fingers.widths[0] == 0 and fingers.positions[0, 0] == pytest.approx(0.004, abs=1e-4)


def test_hands_that_are_not_parallel_grippers():
    one = SLIDING.replace('pos=".06 -.006 0"', 'pos=".06 -.006 0" contype="0"')
    with pytest.raises(RobotFileError, match="only one finger moves"):
        measure(mujoco.MjModel.from_xml_string(one))
    little = SLIDING.replace('range="0 .04"', 'range="0 .002"').replace('range="-.04 0"', 'range="-.002 0"')
    with pytest.raises(RobotFileError, match=r"the fingers open from 2\.0 to 6\.0 mm only"):
        measure(mujoco.MjModel.from_xml_string(little))


def test_a_linkage_whose_pads_turn_with_its_cranks_is_refused():
    """The cranks turn by 1 rad."""
    mjcf = linkage().replace('polycoef="0 -1 0 0 0"', 'polycoef="0 0 0 0 0"')
    with pytest.raises(RobotFileError, match="the pads turn by 57 degrees while the hand opens"):
        measure(mujoco.MjModel.from_xml_string(mjcf))
