"""Odds of the two directions along an axis."""

import numpy as np
import pytest

from perception.detection.axis import TRUST, along, log_odds
from perception.detection.yaw import soft_labels


@pytest.mark.parametrize("angle", [0.0, 2.0, -3.0])
def test_odds_are_for_the_direction_of_a_sure_distribution(angle):
    p = soft_labels(np.array([angle]))[0].astype(np.float64)
    most = np.log((1 + TRUST) / (1 - TRUST))
    assert log_odds(p, along(angle)) == pytest.approx(most, rel=0.05)
    assert log_odds(p, -3.0 * along(angle)) == pytest.approx(-log_odds(p, along(angle)))


def test_odds_are_even_of_what_is_unknown_or_across():
    assert log_odds(np.full(36, 1 / 36), along(0.7)) == pytest.approx(0.0)
    across = soft_labels(np.array([np.pi / 2]))[0].astype(np.float64)
    assert log_odds(across, along(0.0)) == pytest.approx(0.0, abs=0.2)


def test_both_ends_share_a_distribution_with_two_peaks():
    p = 0.8 * soft_labels(np.array([1.0]))[0] + 0.2 * soft_labels(np.array([1.0 + np.pi]))[0]
    assert log_odds(p.astype(np.float64), along(1.0)) == pytest.approx(np.log(4), abs=0.1)
