"""Scenes of the evaluation: test families, seeds, reuse; crashes as results."""

from pathlib import Path

import numpy as np
import pytest

from app.errors import UsageError
from app.evaluation import slam
from app.options import EvaluateOptions
from app.slam import sequences
from sim_assets.datasets import sequences as tables


@pytest.fixture
def written(monkeypatch):
    """Record the sequences that are written instead of rendering them."""
    record = []

    def write(folder, sequence):
        record.append(sequence)
        folder.mkdir(parents=True)
        (folder / "scene_camera.json").write_text("{}")

    monkeypatch.setattr(sequences, "write_sequence", write)
    return record


OPTIONS = EvaluateOptions(what="slam", frames=2, seed=3)


def test_scenes_are_ten_objects_of_the_test_families(written, tmp_path):
    path = slam.ensure_sequence(OPTIONS, tmp_path, 1)
    (table,) = written
    assert path == tmp_path / "sequences" / "scene_1" and path.is_dir()
    assert [item.model.split for item in table.objects] == ["test"] * 10
    assert {item.model.category for item in table.objects} == {"mug", "bowl", "bottle"}
    assert table.config.frames == 2 and table.config.depth_noise == OPTIONS.depth_noise


def test_scenes_depend_on_seed_and_number_and_are_rendered_once(written, tmp_path):
    for scene in (0, 1, 0):
        slam.ensure_sequence(OPTIONS, tmp_path, scene)
    first, second = written
    again = tables.TableSequence(np.random.SeedSequence([3, 0]), first.config)
    np.testing.assert_array_equal(first.Ts_world_camera, again.Ts_world_camera)
    assert not np.array_equal(first.Ts_world_camera, second.Ts_world_camera)


def test_a_crash_of_one_run_is_its_result(monkeypatch, tmp_path):
    def broken(*args):
        raise RuntimeError("no light")

    monkeypatch.setattr(slam, "ensure_sequence", broken)
    line = slam.run_scene(OPTIONS, Path(tmp_path), (2, "no_joint"))
    assert line.pop("seconds") >= 0
    assert line == {
        "key": "2/no_joint", "scene": 2, "variant": "no_joint", "seed": 3,
        "reason": "crashed: RuntimeError: no light",
    }  # fmt: skip


def test_usage_errors_end_the_evaluation(monkeypatch, tmp_path):
    def broken(*args):
        raise UsageError("no such noise")

    monkeypatch.setattr(slam, "ensure_sequence", broken)
    with pytest.raises(UsageError, match="no such noise"):
        slam.run_scene(OPTIONS, Path(tmp_path), (0, "full"))
