"""``nodeslam slam`` end to end: its files, an interruption, and ignored poses."""

import json
import subprocess
import sys

import numpy as np
import pytest

from app.options import SlamOptions
from app.screen import Screen
from app.slam import command as slam
from app.slam.sequence_truth import read_true_trajectory
from app.slam.sequences import write_sequence
from perception.io.detections import write_detections
from perception.io.object_map import read_object_map
from perception.io.recordings.trajectory import read_trajectory
from perception.io.scan_folder import read_scan
from perception.types import ObjectDetection
from sim_assets.datasets.sequences import SequenceConfig, TableSequence

CONFIG = SequenceConfig(frames=3, objects=2, categories=("bottle", "bowl"), spread=0.1, distance=(0.5, 0.6))


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Three frames of two objects with their true masks."""
    folder = tmp_path_factory.mktemp("sequence")
    table = TableSequence(1, CONFIG)
    write_sequence(folder, table)
    found = [
        [
            ObjectDetection(item.model.category, 0.9, image.instances == k)
            for k, item in enumerate(table.objects)
            if (image.instances == k).sum() > 60
        ]
        for image in table.render()
    ]
    write_detections(folder, found)
    return folder


@pytest.fixture(scope="module")
def finished(sequence, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    report = slam.run(SlamOptions(sequence=sequence, out=out, quiet=True), Screen(quiet=True))
    return out, report


def test_a_run_writes_map_trajectory_keyframes_picture_and_replay(finished, sequence):
    out, report = finished
    assert report.success and report.metrics["n_frames"] == 3
    objects = read_object_map(out)
    assert {o.category for o in objects} == {"bottle", "bowl"}
    found, truth = read_trajectory(out / "trajectory.txt"), read_true_trajectory(sequence)
    error = np.linalg.norm(found.Ts_world_camera[:, :3, 3] - truth.Ts_world_camera[:, :3, 3], axis=1)
    assert error.max() < 0.01
    keyframes = json.loads((out / "keyframes.json").read_text())
    scan = read_scan(out / "scan")
    assert keyframes[0]["number"] == 0 and len(keyframes) == len(scan.frames)
    assert {d.instance_id for d in scan.detections[0]} == {o.id for o in objects}
    poses = (out / "bop.csv").read_text().splitlines()
    assert len(poses) == 1 + 2 * 3  # two objects in three images
    for name in ("overview.png", "replay.npz", "replay.json", "replay.glb"):
        assert (out / name).is_file()


def test_an_interruption_keeps_map_and_report(sequence, tmp_path, monkeypatch):
    from app.slam.run import SlamRun

    steps = SlamRun.steps

    def interrupted(self):
        yield next(iter(steps(self)))
        raise KeyboardInterrupt

    monkeypatch.setattr(SlamRun, "steps", interrupted)
    options = SlamOptions(sequence=sequence, out=tmp_path / "run", quiet=True)
    with pytest.raises(KeyboardInterrupt):
        slam.run(options, Screen(quiet=True))
    assert len(read_object_map(options.out)) == 2
    assert json.loads((options.out / "report.json").read_text())["reason"].startswith("interrupted")


def test_poses_after_the_first_are_ignored(sequence, finished, tmp_path):
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(sequence, copy)
    path = copy / "scene_camera.json"
    cameras = json.loads(path.read_text())
    for key in ("1", "2"):
        cameras[key] |= {name: cameras["0"][name] for name in ("cam_R_w2c", "cam_t_w2c")}
    path.write_text(json.dumps(cameras))
    options = SlamOptions(sequence=copy, out=tmp_path / "run", quiet=True)
    slam.run(options, Screen(quiet=True))
    mine, others = (read_trajectory(out / "trajectory.txt") for out in (options.out, finished[0]))
    np.testing.assert_allclose(mine.Ts_world_camera, others.Ts_world_camera, atol=1e-9)


def test_pytorch_is_not_loaded_on_the_cpu(tmp_path):
    write_sequence(tmp_path / "sequence", TableSequence(1, CONFIG))
    code = "import sys; from app.cli import run; code = run(sys.argv[1:])\n"
    code += "sys.exit(7 if 'torch' in sys.modules else code)"
    arguments = ["slam", tmp_path / "sequence", "--device", "cpu", "--out", tmp_path / "run", "--quiet"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert read_object_map(tmp_path / "run")
