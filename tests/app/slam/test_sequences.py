"""Written sequences: the first pose only, and the ground truth apart."""

import json

import numpy as np

from app.slam.sequence_truth import read_true_objects, read_true_trajectory
from app.slam.sequences import is_complete, write_sequence
from sim_assets.datasets.sequences import SequenceConfig, TableSequence

CONFIG = SequenceConfig(width=80, height=60, frames=2, objects=2, categories=("bottle", "bowl"), spread=0.1)


def test_a_sequence_has_the_first_pose_and_its_ground_truth_apart(tmp_path):
    table, done = TableSequence(1, CONFIG), []
    assert not is_complete(tmp_path)
    write_sequence(tmp_path, table, lambda *progress: done.append(progress))
    assert is_complete(tmp_path) and done == [(1, 2), (2, 2)]
    cameras = json.loads((tmp_path / "scene_camera.json").read_text())
    assert ["cam_R_w2c" in camera for camera in cameras.values()] == [True, False]
    truth = read_true_trajectory(tmp_path)
    np.testing.assert_allclose(truth.times, [0, 1 / table.rate], atol=1e-6)
    np.testing.assert_allclose(truth.Ts_world_camera, table.Ts_world_camera, atol=1e-5)
    for (category, mesh), item in zip(read_true_objects(tmp_path), table.objects, strict=True):
        assert category == item.model.category
        middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))[:2] / 2
        assert np.linalg.norm(middle - item.T_world_object[:2, 3]) < 0.03
