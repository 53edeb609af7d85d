"""Poses of nodes in the scene."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.viewer.display import DisplayOptions, pose_arguments, set_pose
from perception.geometry import pose_from_yaw


def test_poses_are_positions_and_quaternions_wxyz():
    T = pose_from_yaw(np.pi / 2, np.array([1.0, 2.0, 3.0]))
    arguments, node = pose_arguments(T), SimpleNamespace()
    set_pose(node, T)
    for position, wxyz in ((arguments["position"], arguments["wxyz"]), (node.position, node.wxyz)):
        np.testing.assert_array_equal(position, (1, 2, 3))
        assert wxyz == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])


def test_by_default_reconstructions_are_shown_with_everything_else():
    options = DisplayOptions()
    assert (options.objects, options.coloring) == ("reconstructed", "class")
    assert options.goals and options.cameras and options.motion and options.labels and options.shadows
