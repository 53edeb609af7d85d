"""Scenes of the evaluation: test families, seeds, reuse; crashes as results."""

import json
from dataclasses import replace

import numpy as np
import pytest

from app.evaluation import slam
from app.options import EvaluateOptions
from app.screen import Screen
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


def test_failed_runs_are_reported_and_the_report_is_written(monkeypatch, tmp_path):
    monkeypatch.setattr(slam, "ensure_sequence", lambda *_: 1 / 0)
    monkeypatch.setattr("perception.fusion.tsdf.load_open3d", lambda: None)
    options = replace(OPTIONS, scenes=1, variants=("full", "no_joint"), out=tmp_path)
    report = slam.run(options, Screen(quiet=True))
    assert not report.success and report.reason == "2 of 2 runs, 2 crashed"
    assert {row["reason"] for row in report.metrics["rows"]} == {
        "crashed: ZeroDivisionError: division by zero"
    }
    assert {v["n_failed"] for v in report.metrics["variants"].values()} == {1}
    path = tmp_path / slam.ROWS
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["key"] for line in lines] == ["0/full", "0/no_joint"]
    lines[1]["seed"] = 4  # of another evaluation
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    again = slam.run(replace(options, resume=True), Screen(quiet=True))
    assert again.reason == report.reason
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == [3, 3]
