"""Sums over classes in resting poses."""

import numpy as np
import pytest

from perception.detection.poses import class_mass, pose_mass
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
