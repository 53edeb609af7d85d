"""Scores of the pose network and of the evidence together."""

import pytest

from perception.inference.pose_score import agreed


def test_network_and_evidence_have_the_same_weight() -> None:
    assert agreed(0.5, 0.5) == pytest.approx(0.5)
    assert agreed(0.9, 0.1) == pytest.approx(0.5)
    assert agreed(0.9, 0.5) == pytest.approx(0.75)  # the square root of odds of 9
    assert agreed(1.0, 0.2) == 1.0 and agreed(0.0, 0.9) == 0.0
