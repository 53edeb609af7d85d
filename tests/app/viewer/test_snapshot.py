"""Plain values of a snapshot."""

import numpy as np
import pytest

from app.viewer.snapshot import ObjectState, Snapshot, StageSpan, pose_matrix


def test_stage_titles_are_those_of_the_report_and_of_slam():
    assert [StageSpan(name, 0.0).title for name in ("scan", "execute", "lost", "own")] == [
        "Scan", "Execute", "Tracking lost", "Own",
    ]  # fmt: skip


def test_the_name_of_an_object_is_its_class_and_id():
    state = ObjectState(3, "mug", None, np.eye(4), np.ones(3), np.zeros(16))
    assert state.name == "mug_3"


@pytest.mark.parametrize(("stage", "expected"), [("scan", 4), ("detect", 2), ("execute", 4), ("slam", 4)])
def test_the_latest_image_is_the_one_searched_during_detection_else_the_one_captured(stage, expected):
    assert Snapshot(stage=stage, n_frames=5, n_searched=3).latest_image == expected
    assert Snapshot(stage=stage).latest_image == -1


def test_a_pose_is_position_and_quaternion_wxyz():
    quarter = np.sqrt(0.5)
    T = pose_matrix(np.array([1, 2, 3, quarter, 0, 0, quarter]))  # 90 degrees about z
    np.testing.assert_allclose(T, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-12)
