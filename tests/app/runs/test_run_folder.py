"""Run folders: complete files or none, whatever happens to the process."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from app.errors import UsageError
from app.options import PackOptions
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import RunFolder
from perception.io.files import write_atomically

REQUIRED = {"command", "seed", "version", "success", "reason", "timings", "objects", "metrics"}


def test_a_folder_has_a_readable_report_from_the_first_moment(tmp_path):
    folder = RunFolder.create(PackOptions(out=tmp_path / "run", seed=3), "pack")
    report = json.loads((folder.path / "report.json").read_text())
    assert set(report) >= REQUIRED and report["seed"] == 3
    assert report["success"] is False and report["reason"].startswith("stopped before")


def test_the_default_name_tells_command_and_seed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = RunFolder.create(PackOptions(seed=5), "pack")
    assert folder.path.parent.name == "runs" and folder.path.name.endswith("_pack_seed5")


def test_an_earlier_run_is_replaced_and_other_files_stay(tmp_path):
    first = RunFolder.create(PackOptions(out=tmp_path / "run"), "pack")
    first.write_json("plan.json", {"old": True})
    (first.path / "objects").mkdir()
    (first.path / "notes.txt").write_text("mine")
    RunFolder.create(PackOptions(out=tmp_path / "run"), "pack")
    assert sorted(path.name for path in first.path.iterdir()) == ["notes.txt", "report.json"]


def test_a_file_in_the_way_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        RunFolder.create(PackOptions(out=tmp_path / "run"), "pack")


def test_report_json_speaks_plain_json(tmp_path):
    report = Report(
        "pack",
        1,
        objects=[ObjectReport(2, "mug", True, 0.5, float("inf"), details={"pixels": np.int64(7)})],
        metrics={"ci": (0.0, 1.0), "array": np.arange(2), "flag": np.bool_(True)},
    )
    RunFolder(tmp_path).write_report(report)
    read = json.loads((tmp_path / "report.json").read_text())
    assert read["objects"][0] == {
        "id": 2,
        "category": "mug",
        "placed": True,
        "error_position": 0.5,
        "error_tilt": None,
        "attempts": 0,
        "reason": "",
        "pixels": 7,
    }
    assert read["metrics"] == {"ci": [0.0, 1.0], "array": [0, 1], "flag": True}


def test_a_failed_write_leaves_the_old_file_and_no_debris(tmp_path, monkeypatch):
    path = tmp_path / "report.json"
    write_atomically(path, "old")

    def full(*args):
        raise OSError("no space left on device")

    monkeypatch.setattr("perception.io.files.os.replace", full)
    with pytest.raises(OSError, match="no space"):
        write_atomically(path, "new")
    assert path.read_text() == "old" and [p.name for p in tmp_path.iterdir()] == ["report.json"]


def test_a_process_killed_while_writing_leaves_readable_files(tmp_path):
    code = (
        "import sys; from pathlib import Path; from perception.io.files import write_json\n"
        "for i in range(10**9): write_json(Path(sys.argv[1]) / 'report.json', {'i': i, 'pad': 'x' * 200000})"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    deadline = time.monotonic() + 30
    while not (tmp_path / "report.json").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert len(json.loads((tmp_path / "report.json").read_text())["pad"]) == 200000
