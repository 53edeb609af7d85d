"""Scores of the pose network and of the evidence together."""

import numpy as np
import pytest

from perception.inference.pose_score import agreed, class_mass, pose_mass
from perception.types import POSED_CLASSES


def test_classes_in_one_pose_share_its_probability() -> None:
    p = np.zeros(10)
    p[POSED_CLASSES.index(("can", "lying"))], p[POSED_CLASSES.index(("bottle", "lying"))] = 0.4, 0.5
    assert pose_mass(p, "lying") == pytest.approx(0.9)
    assert pose_mass(p, "upside-down") == 0.0


def test_the_poses_of_a_class_share_its_probability() -> None:
    p = np.zeros(len(POSED_CLASSES) + 1)
    p[[POSED_CLASSES.index(("can", "upright")), POSED_CLASSES.index(("can", "lying")), -1]] = 0.3, 0.5, 0.2
    assert class_mass(p, "can") == pytest.approx(0.8)
    assert class_mass(p, "bottle") == 0.0


def test_network_and_evidence_have_the_same_weight() -> None:
    assert agreed(0.5, 0.5) == pytest.approx(0.5)
    assert agreed(0.9, 0.1) == pytest.approx(0.5)
    assert agreed(0.9, 0.5) == pytest.approx(0.75)  # the square root of odds of 9
    assert agreed(1.0, 0.2) == 1.0 and agreed(0.0, 0.9) == 0.0
