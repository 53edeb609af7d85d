"""Ground truth of a sequence folder."""

import json

import numpy as np
import pytest

from app.slam.sequence_truth import TRUTH, read_true_objects, read_true_trajectory
from perception.errors import InvalidInputError
from perception.io.files import write_atomically
from perception.io.object_map import ply_bytes
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.types import TriangleMesh


def trajectory(x):
    T = np.eye(4)
    T[0, 3] = x
    return Trajectory.of([0.0, 0.1], [np.eye(4), T])


def test_the_trajectory_of_the_truth_folder_precedes_that_of_tum(tmp_path):
    assert read_true_trajectory(tmp_path) is None
    write_trajectory(tmp_path / "groundtruth.txt", trajectory(1.0))
    assert read_true_trajectory(tmp_path).Ts_world_camera[1, 0, 3] == 1.0
    (tmp_path / TRUTH).mkdir()
    write_trajectory(tmp_path / TRUTH / "trajectory.txt", trajectory(2.0))
    assert read_true_trajectory(tmp_path).Ts_world_camera[1, 0, 3] == 2.0


def test_true_objects_have_class_and_surface(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    mesh = TriangleMesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    write_atomically(tmp_path / TRUTH / "objects" / "0_mug.ply", ply_bytes(mesh))
    entries = [{"category": "mug", "mesh": "objects/0_mug.ply"}]
    (tmp_path / TRUTH / "objects.json").write_text(json.dumps(entries))
    ((category, read),) = read_true_objects(tmp_path)
    assert category == "mug"
    np.testing.assert_allclose(read.vertices, vertices, atol=1e-6)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({}, "Expected `array`"),
        ([{"category": "mug"}], r"missing required field `mesh` - at `\$\[0\]`"),
        ([{"category": "cup", "mesh": "objects/0_cup.ply"}], "Invalid enum value 'cup'"),
        ([{"category": "mug", "mesh": "../../secret.ply"}], "leads out of the folder"),
    ],
)
def test_malformed_truth_is_named(tmp_path, entries, message):
    (tmp_path / TRUTH).mkdir()
    (tmp_path / TRUTH / "objects.json").write_text(json.dumps(entries))
    with pytest.raises(InvalidInputError, match=rf"objects\.json: .*{message}.* generated here"):
        read_true_objects(tmp_path)
