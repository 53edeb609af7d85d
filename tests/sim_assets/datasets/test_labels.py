"""Labels of items at known poses."""

import numpy as np
import pytest

from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.labels import InstanceLabel


@pytest.mark.parametrize("yaw", [-2.0, 0.0, 3.0])
def test_yaw_of_a_label(yaw):
    label = InstanceLabel(None, PlanarPose(1, 2, yaw).matrix, 0, 0.0, 0.0, np.zeros(3))
    assert label.yaw == pytest.approx(yaw)
