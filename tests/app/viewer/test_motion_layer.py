"""Paths and grasp candidates in the scene."""

import numpy as np
import pytest

from app.viewer.display import DisplayOptions
from app.viewer.motion_layer import (
    CANDIDATE_COLOR,
    GRIPPER_OUTLINE,
    MAX_CANDIDATES,
    PATH_COLOR,
    SELECTED_COLOR,
    MotionLayer,
    gripper_outlines,
)  # fmt: skip
from app.viewer.snapshot import Snapshot
from perception.geometry import pose_from_yaw

PATH = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 2.0, 0.0)])
OPTIONS = DisplayOptions()


def grasps(count):
    return np.array([pose_from_yaw(0.0, np.array([0.1 * i, 0.0, 0.2])) for i in range(count)])


@pytest.fixture
def layer(server):
    return MotionLayer(server)


def test_a_path_joins_consecutive_points(layer, node):
    layer.draw(Snapshot(path=PATH), OPTIONS)
    np.testing.assert_allclose(node("/motion/path").points, [[PATH[0], PATH[1]], [PATH[1], PATH[2]]])
    assert np.unique(node("/motion/path").colors.reshape(-1, 3), axis=0).tolist() == [list(PATH_COLOR)]
    first = node("/motion/path")
    layer.draw(Snapshot(path=PATH), OPTIONS)
    assert node("/motion/path") is first  # an unchanged path is not sent again
    layer.draw(Snapshot(path=PATH[:2]), OPTIONS)
    assert len(node("/motion/path").points) == 1
    layer.draw(Snapshot(), OPTIONS)
    assert node("/motion/path") is None


def test_the_selected_grasp_has_a_colour_of_its_own(layer, node):
    layer.draw(Snapshot(grasps=grasps(3)), OPTIONS)
    selected, candidates = node("/motion/selected"), node("/motion/candidates")
    np.testing.assert_allclose(selected.points, gripper_outlines(grasps(1)), atol=1e-6)
    np.testing.assert_allclose(candidates.points, gripper_outlines(grasps(3)[1:]), atol=1e-6)
    assert np.unique(selected.colors.reshape(-1, 3), axis=0).tolist() == [list(SELECTED_COLOR)]
    assert np.unique(candidates.colors.reshape(-1, 3), axis=0).tolist() == [list(CANDIDATE_COLOR)]
    layer.draw(Snapshot(grasps=grasps(3)), OPTIONS)
    assert node("/motion/selected") is selected
    layer.draw(Snapshot(grasps=grasps(1)), OPTIONS)
    assert node("/motion/selected") is not selected and node("/motion/candidates") is None
    layer.draw(Snapshot(), OPTIONS)
    assert node("/motion/selected") is None


def test_many_candidates_are_thinned_out(layer, node):
    layer.draw(Snapshot(grasps=grasps(1 + 4 * MAX_CANDIDATES)), OPTIONS)
    assert len(node("/motion/candidates").points) == MAX_CANDIDATES * len(GRIPPER_OUTLINE)


def test_motion_can_be_hidden(layer, node):
    layer.draw(Snapshot(path=PATH, grasps=grasps(2)), OPTIONS)
    layer.draw(Snapshot(path=PATH, grasps=grasps(2)), DisplayOptions(motion=False))
    assert [node(f"/motion/{name}") for name in ("path", "selected", "candidates")] == [None] * 3


def test_outlines_are_rotated_and_moved_with_the_tcp():
    T = pose_from_yaw(np.pi / 2, np.array([1.0, 2.0, 3.0]))
    points = gripper_outlines(T[None])
    np.testing.assert_allclose(points[0], [(1.03, 2, 2.95), (0.97, 2, 2.95)], atol=1e-12)  # the palm
    assert points.shape == (len(GRIPPER_OUTLINE), 2, 3)
