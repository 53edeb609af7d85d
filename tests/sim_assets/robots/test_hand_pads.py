"""Pads found on points of fingers, and the joints' motion over the opening between them."""

import numpy as np
import pytest

from sim_assets.errors import RobotFileError
from sim_assets.robots.finger_motion import HandSweep
from sim_assets.robots.hand_pads import find_pads, finger_motion, reversed_sweep

HEIGHTS = np.linspace(0.0, 0.1, 101)


def stations(*gaps, recess=0.0):
    """Two straight fingers with points every millimetre of z; below z = 0.06 they stand back by a recess."""
    back = np.where(HEIGHTS < 0.06, recess, 0.0)
    fingers = [
        np.concatenate(
            [np.stack([0 * HEIGHTS, side * (gap / 2 + back), HEIGHTS], axis=1) for side in (1, -1)]
        )
        for gap in gaps
    ]
    return np.array(fingers), np.arange(202) < 101


def sweep(*positions):
    column = np.array(positions)[:, None]
    return HandSweep(("drive",), column, column, 1)


@pytest.mark.parametrize("gaps", [(0.0, 0.08), (0.08, 0.0)])
def test_pads_are_where_the_fingers_are_nearest(gaps):
    points, left = stations(*gaps, recess=0.01)
    pads = find_pads(points, left, ~left)
    for pad in pads:
        assert points[0, pad, 2].min() >= 0.057 and points[0, pad, 2].max() == pytest.approx(0.1)
    assert left[pads[0]].all() and not left[pads[1]].any()


def test_fingers_beside_each_other_have_no_pads():
    points, left = stations(0.0, 0.08)
    points[:, left, 2] += 1.0
    with pytest.raises(RobotFileError, match="not opposite to each other"):
        find_pads(points, left, ~left)


def test_openings_begin_where_the_pads_meet():
    motion = finger_motion(sweep(0.0, 1.0, 2.0), np.array([-0.01, 0.01, 0.03]))
    np.testing.assert_allclose(motion.widths, (0, 0.01, 0.03))
    np.testing.assert_allclose(motion.positions[:, 0], (0.5, 1.0, 2.0))


def test_a_sweep_is_reversed():
    assert reversed_sweep(sweep(0.0, 1.0, 2.0)).positions[:, 0].tolist() == [2, 1, 0]
