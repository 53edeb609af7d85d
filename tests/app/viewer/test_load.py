import subprocess
import sys

import pytest

from app.errors import UsageError
from app.viewer.load import load_run
from app.viewer.timeline import Story
from perception.errors import InvalidInputError
from perception.io.object_map import write_object_map


def test_a_run_folder_is_shown_without_a_simulator(run_folder, recording):
    shown = load_run(run_folder)
    assert shown.recorder.now == pytest.approx(recording.now, abs=0.01)
    assert set(shown.recorder.meshes) == set(recording.meshes)
    assert len(shown.recorder.frames) == 2 and shown.recorder.objects[0].category == "can"
    assert shown.report["seed"] == 3


def test_folders_without_a_replay_are_told_in_order(run_folder, tmp_path, recording):
    for name in ("replay.json", "replay.npz", "replay.glb"):
        (run_folder / name).unlink()
    story = Story(load_run(run_folder).recorder)
    assert [span.name for span in story.stages] == ["scan", "detect", "reconstruct"]
    end = story.at(story.end)
    assert end.n_frames == 2 and end.objects[0].status == "reconstructed"
    write_object_map(tmp_path / "map", recording.objects)
    only_map = Story(load_run(tmp_path / "map").recorder)
    assert only_map.at(only_map.end).objects[0].name == "can_0"


def test_what_cannot_be_shown_is_named(tmp_path, run_folder):
    with pytest.raises(UsageError, match="is no folder"):
        load_run(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="nothing to show"):
        load_run(tmp_path / "empty")
    (run_folder / "replay.npz").unlink()
    with pytest.raises(InvalidInputError, match=r"replay\.npz is missing"):
        load_run(run_folder)


def test_replays_need_no_simulator_installed():
    program = """
import sys
sys.modules.update(dict.fromkeys(("mujoco", "mjviser", "mink", "ruckig"), None))
import app.viewer.command
import app.viewer.page
"""
    subprocess.run([sys.executable, "-c", program], check=True)
