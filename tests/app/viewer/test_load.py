"""Reading and validation of the files that the viewer shows."""

import json
import re
import subprocess
import sys

import pytest

from app import cli
from app.errors import UsageError
from app.viewer.load import RunSummary, load_run, read_summary
from app.viewer.snapshot import ObjectOutcome
from app.viewer.timeline import Timeline
from perception.errors import InvalidInputError
from perception.io.object_map import write_object_map


def test_a_run_folder_is_read_with_all_its_files(run_folder, recording):
    loaded = load_run(run_folder)
    assert loaded.recorder.now == pytest.approx(recording.now, abs=0.01)
    assert set(loaded.recorder.meshes) == set(recording.meshes)
    assert len(loaded.recorder.frames) == 2 and loaded.recorder.objects[0].category == "can"
    assert loaded.summary == RunSummary("pack", 3, "1 of 1", {})


def test_results_without_a_recording_are_shown_one_after_another(run_folder, tmp_path, recording):
    for name in ("replay.json", "replay.npz", "replay.glb"):
        (run_folder / name).unlink()
    timeline = Timeline(load_run(run_folder).recorder)
    assert [span.name for span in timeline.stages] == ["scan", "detect", "reconstruct"]
    end = timeline.at(timeline.end)
    assert end.n_frames == end.n_searched == 2 and end.objects[0].status == "reconstructed"
    write_object_map(tmp_path / "map", recording.objects)
    only_map = Timeline(load_run(tmp_path / "map").recorder)
    assert only_map.at(only_map.end).objects[0].name == "can_0"


def test_folders_with_nothing_to_show_are_refused(tmp_path, run_folder):
    with pytest.raises(UsageError, match="is not a folder"):
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


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("replay.json", '{"bodies": [', r"replay\.json is not valid JSON"),
        ("replay.json", "[]", r"replay\.json must hold the lists bodies, of different names, and"),
        ("replay.json", '{"bodies": [], "notes": [[0, "fit", {"id": 0}]]}', r"note 0: category is missing"),
        ("replay.npz", "no archive", r"replay\.npz is not a readable replay"),
        ("report.json", "{", r"report\.json is not valid JSON"),
        ("report.json", "[1]", r"report\.json: it must be an object: run it again"),
        ("report.json", '{"objects": {}}', r"report\.json: objects must be a list"),
        ("report.json", '{"objects": [7]}', r"report\.json: object 0: it must be an object"),
        ("objects.json", "{", r"objects\.json is not valid JSON"),
        ("objects.json", "{}", r"objects\.json must be a list"),
        ("objects.json", '[{"id": 0}]', r"objects\.json, object 0: 'category' is missing"),
    ],
)
def test_malformed_files_end_the_command_before_it_serves(
    run_folder, monkeypatch, capsys, name, content, message
):
    (run_folder / name).write_text(content)
    monkeypatch.setattr("app.viewer.command.open_server", lambda *_: pytest.fail("it must not serve"))
    assert cli.run(["view", str(run_folder)]) == cli.BAD_INPUT
    error = capsys.readouterr().err
    assert re.search(message, error) and error.startswith("nodeslam: ") and error.count("\n") == 1


def test_quaternions_that_are_not_of_length_1_are_refused(run_folder, recording):
    recording.poses[3][1, 3:] = (0.9, 0.9, 0.0, 0.0)
    recording.write(run_folder)
    with pytest.raises(InvalidInputError, match=r"sample 3: the quaternion of tcp is not of length 1"):
        load_run(run_folder)


def summary_of(tmp_path, **report):
    (tmp_path / "report.json").write_text(json.dumps(report))
    return read_summary(tmp_path / "report.json")


def test_the_summary_holds_the_outcomes_by_id(tmp_path):
    objects = [
        {"id": 2, "placed": True, "error_position": 0.004},
        {"id": -1, "placed": False, "error_position": None},
        {"id": 5, "placed": None},
    ]
    summary = summary_of(tmp_path, command="sort", seed=7, reason="2 of 3", objects=objects)
    outcomes = {2: ObjectOutcome(True, 0.004), -1: ObjectOutcome(False), 5: ObjectOutcome(False)}
    assert summary == RunSummary("sort", 7, "2 of 3", outcomes)
    assert read_summary(tmp_path / "missing.json") == summary_of(tmp_path) == RunSummary()


@pytest.mark.parametrize(
    ("report", "message"),
    [
        ({"command": 3}, "command must be text"),
        ({"reason": ["a"]}, "reason must be text"),
        ({"success": "yes"}, "success must be true or false"),
        ({"seed": "3"}, "seed must be an integer"),
        ({"seed": True}, "seed must be an integer"),
        ({"objects": [{"placed": True}]}, "object 0: id is missing"),
        ({"objects": [{"id": 0}, {"id": "1"}]}, "object 1: id must be an integer"),
        ({"objects": [{"id": 0, "placed": "yes"}]}, "object 0: placed must be true, false or null"),
        (
            {"objects": [{"id": 0, "error_position": "4 mm"}]},
            "error_position must be a finite number",
        ),
        ({"objects": [{"id": 0, "error_position": float("nan")}]}, "holds NaN"),
    ],
)
def test_a_malformed_report_names_its_field(tmp_path, report, message):
    with pytest.raises(InvalidInputError, match=rf"report\.json:? .*{message}.*: run it again"):
        summary_of(tmp_path, **report)
