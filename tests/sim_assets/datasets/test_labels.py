"""Labels of items at known poses."""

import numpy as np
import pytest

from sim_assets.cell.layout import PlanarPose
from sim_assets.datasets.labels import InstanceLabel


@pytest.mark.parametrize("yaw", [-2.0, 0.0, 3.0])
def test_yaw_of_a_label(yaw):
    label = InstanceLabel(None, PlanarPose(1, 2, yaw).matrix, 0, 0.0, 0.0, np.zeros(3))
    assert label.yaw == pytest.approx(yaw) == label.direction


def test_the_axis_of_a_lying_item_points_where_its_top_is():
    """The top of a lying mesh is at -y (``training_scenes``); turned by a right angle it is at +x."""
    pose = PlanarPose(1, 2, np.pi / 2).matrix
    label = InstanceLabel("can", pose, 0, 0.0, 0.0, np.zeros(3), True, "lying")
    assert label.direction == pytest.approx(0.0)
    np.testing.assert_allclose(pose[:3, :3] @ (0, -1, 0), (1, 0, 0), atol=1e-12)
