"""Run folders: complete files or none, whatever happens to the process."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from app.errors import UsageError
from app.options import ArOptions, PackOptions, SlamOptions
from app.runs.lock import LOCK_FILE, FolderLock
from app.runs.manifest import MANIFEST_FILE, read_manifest
from app.runs.report import ObjectReport, Report
from app.runs.run_folder import PREVIOUS, RunFolder, finish_all, open_folders, replaced_runs
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


def names(folder):
    """Return the relative names of all files in a folder, except the manifests."""
    found = (str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir())
    return sorted(name for name in found if not name.endswith(MANIFEST_FILE))


def stored(path, command="pack", complete=True):
    """Write a run with a plan and a scan, and finish it."""
    options = PackOptions(out=path)
    with contextlib.suppress(RuntimeError), RunFolder.create(options, command) as folder:
        folder.write_json("plan.json", {"old": True})
        (folder.scan / "rgb").mkdir(parents=True)
        (folder.scan / "rgb" / "000000.png").write_text("image")
        if not complete:
            raise RuntimeError
    return folder


RUN = ["plan.json", "report.json", "scan/rgb/000000.png"]


def test_a_run_is_replaced_and_other_files_stay(tmp_path):
    first = stored(tmp_path / "run")
    for name in ("notes.txt", "scan/mine.png", "scan/rgb/mine.png"):
        (first.path / name).write_text("mine")
    with RunFolder.create(PackOptions(out=first.path), "doctor"):
        pass
    assert names(first.path) == ["notes.txt", "report.json", "scan/mine.png", "scan/rgb/mine.png"]
    assert json.loads((first.path / "report.json").read_text())["command"] == "doctor"


def test_empty_folders_of_the_replaced_run_are_removed(tmp_path):
    first = stored(tmp_path / "run")
    (first.path / "mine").mkdir()
    RunFolder.create(PackOptions(out=first.path), "doctor").finish(complete=True)
    assert {path.name for path in first.path.iterdir()} == {"mine", "report.json", MANIFEST_FILE}


def test_a_run_of_a_version_without_manifests_is_replaced(tmp_path):
    (tmp_path / "scan").mkdir()
    for name in ("video.webp", "trajectory.txt", "episodes.jsonl", ".video.mp4.partial.mp4", "scan/mine.png"):
        (tmp_path / name).write_text("old")
    (tmp_path / "report.json").write_text(Report("pack", 0).to_json())
    with RunFolder.create(PackOptions(out=tmp_path), "scan"):
        pass
    assert names(tmp_path) == ["report.json", "scan/mine.png"]


@pytest.mark.parametrize("content", ['{"tool": "pytest", "passed": 3}', "[]", "{", ""])
def test_the_folder_of_another_program_is_left_alone(tmp_path, content):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "000000.png").write_text("wedding")
    (tmp_path / "report.json").write_text(content)
    with pytest.raises(UsageError, match="is not empty and no run folder"):
        RunFolder.create(PackOptions(out=tmp_path), "doctor")
    assert names(tmp_path) == ["pictures/000000.png", "report.json"]
    assert (tmp_path / "report.json").read_text() == content


def test_files_that_were_changed_or_added_since_are_kept_aside(tmp_path):
    first = stored(tmp_path / "run")
    (first.path / "plan.json").write_text("edited by hand")
    (first.path / "video.mp4").write_text("made by hand")
    RunFolder.create(PackOptions(out=first.path), "doctor").finish(complete=True)
    kept = next(first.path.glob("changed_files_*"))
    assert {path.name: path.read_text() for path in kept.iterdir()} == {
        "plan.json": "edited by hand",
        "video.mp4": "made by hand",
    }
    assert names(first.path) == [f"{kept.name}/plan.json", f"{kept.name}/video.mp4", "report.json"]


def test_a_run_that_ends_before_its_first_result_restores_the_one_it_replaced(tmp_path):
    first = stored(tmp_path / "run")
    before = {name: (first.path / name).read_bytes() for name in [*RUN, MANIFEST_FILE]}
    with pytest.raises(KeyboardInterrupt), RunFolder.create(PackOptions(out=first.path), "sort"):
        assert names(first.path / PREVIOUS) == RUN
        raise KeyboardInterrupt
    assert {name: (first.path / name).read_bytes() for name in before} == before
    assert names(first.path) == RUN


def test_an_interrupted_run_with_results_keeps_them_and_the_one_it_replaced(tmp_path):
    path = stored(tmp_path / "run").path
    with pytest.raises(KeyboardInterrupt), RunFolder.create(PackOptions(out=path), "sort") as folder:
        folder.write_json("objects.json", [])
        raise KeyboardInterrupt
    assert names(path) == [*(f"{PREVIOUS}/{name}" for name in RUN), "objects.json", "report.json"]
    assert replaced_runs([path]) == [path / PREVIOUS]
    with RunFolder.create(PackOptions(out=path), "scan"):
        assert names(path / PREVIOUS) == RUN and "objects.json" not in names(path)
    assert names(path) == ["report.json"] and not (path / PREVIOUS).exists()


def test_an_interrupted_run_is_not_deleted_by_the_next_before_that_is_complete(tmp_path):
    path = stored(tmp_path / "run", complete=False).path
    with pytest.raises(KeyboardInterrupt), RunFolder.create(PackOptions(out=path), "sort"):
        raise KeyboardInterrupt
    assert names(path) == RUN and read_manifest(path).state == "running"


def run_killed_at_step(step, path, ends):
    """Replace a run in a process that dies after so many changes of the folder; return its exit code."""
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    done = 0

    def dying(function):
        def counted(*arguments, **named):
            nonlocal done
            done += 1
            if done > step:
                os._exit(137)
            return function(*arguments, **named)

        return counted

    for name in ("replace", "unlink", "rmdir", "mkdir"):
        setattr(os, name, dying(getattr(os, name)))
    folder = RunFolder.create(PackOptions(out=path), "sort")
    if ends != "at once":
        folder.write_json("objects.json", [])
    folder.finish(complete=ends == "completing")
    os._exit(0)


def contents(folder):
    return {name: (folder / name).read_bytes() for name in names(folder)} if folder.is_dir() else {}


@pytest.mark.parametrize("ends", ["completing", "interrupted", "at once"])
def test_killed_at_any_step_nothing_is_lost_and_the_next_run_clears_up(tmp_path, ends):
    finished, step = False, 0
    while not finished:
        path = tmp_path / str(step)
        old = contents(stored(path).path)
        (path / "notes.txt").write_text("mine")
        finished = run_killed_at_step(step, path, ends) == 0
        now = contents(path) | {n: c for n, c in contents(path / PREVIOUS).items() if n in RUN}
        complete = read_manifest(path) is not None and read_manifest(path).state == "complete"
        new = json.loads((path / "report.json").read_bytes() if (path / "report.json").exists() else "{}")
        replaced = complete and new.get("command") == "sort"
        assert replaced or {name: now[name] for name in RUN} == old, step
        assert (path / "notes.txt").read_text() == "mine"
        with RunFolder.create(PackOptions(out=path), "scan"):
            pass
        assert names(path) == ["notes.txt", "report.json"], step
        assert not [entry for entry in path.iterdir() if entry.name.startswith(".")], step
        step += 1
    assert step > 15


def test_two_runs_in_one_folder_are_refused(tmp_path):
    code = (
        "import sys, time; from pathlib import Path; from app.options import PackOptions\n"
        "from app.runs.run_folder import RunFolder\n"
        "RunFolder.create(PackOptions(out=Path(sys.argv[1])), 'pack')\n"
        "print('open', flush=True); time.sleep(60)"
    )
    path = tmp_path / "run"
    other = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    assert other.stdout is not None and other.stdout.readline() == b"open\n"
    before = contents(path)
    with pytest.raises(UsageError, match=f"in use by another run .process {other.pid}"):
        RunFolder.create(PackOptions(out=path), "scan")
    assert contents(path) == before
    other.kill()
    other.wait()
    other.stdout.close()
    RunFolder.create(PackOptions(out=path), "scan").finish(complete=True)


def test_a_linked_folder_is_refused(tmp_path):
    path = stored(tmp_path / "run").path
    (path / "scan" / "rgb" / "000000.png").unlink()
    (path / "scan" / "rgb").rmdir()
    (tmp_path / "elsewhere").mkdir()
    (path / "scan" / "rgb").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UsageError, match="scan/rgb is a symbolic link"):
        RunFolder.create(PackOptions(out=path), "scan")
    assert (path / "plan.json").exists()


def test_an_input_is_never_cleared(tmp_path):
    path = stored(tmp_path / "run").path
    before = contents(path)
    for options in (ArOptions(run=path, out=path), SlamOptions(sequence=path / "scan", out=path)):
        with pytest.raises(UsageError, match="give another folder"):
            RunFolder.create(options, "ar")
    with pytest.raises(UsageError, match="contains the input"):
        RunFolder.create(PackOptions(out=path), "pack", also_read=[path / "scan"])
    assert contents(path) == before


def test_training_continues_in_the_folder_of_a_training(tmp_path):
    path = stored(tmp_path / "run", "train-detector").path
    with RunFolder.create(PackOptions(out=path), "train-yaw", continues="train"):
        assert names(path) == [LOCK_FILE, *RUN]
    with RunFolder.create(PackOptions(out=path), "pack"):
        pass
    with RunFolder.create(PackOptions(out=path), "train-yaw", continues="train"):
        assert names(path) == [LOCK_FILE, f"{PREVIOUS}/report.json", "report.json"]


def test_a_resumed_run_keeps_its_files(tmp_path):
    path = stored(tmp_path / "run", complete=False).path
    options = PackOptions(out=path)
    with RunFolder.resume(options, path, "pack"):
        assert names(path) == [LOCK_FILE, *RUN]
        with pytest.raises(UsageError, match="in use"):
            FolderLock(path)
    assert read_manifest(path).state == "complete"
    with pytest.raises(UsageError, match="is not a folder"):
        RunFolder.resume(options, tmp_path / "nowhere", "pack")


@pytest.mark.parametrize("name", ["x" * 300, "loop/run"])
def test_a_path_that_cannot_be_a_folder_is_refused(tmp_path, name):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(UsageError, match="cannot be written"):
        RunFolder.create(PackOptions(out=tmp_path / name), "pack")


def test_all_open_folders_are_finished(tmp_path):
    first = RunFolder.create(PackOptions(out=tmp_path / "a"), "pack")
    assert open_folders() == [first.path]
    assert finish_all(complete=False) == [first.path]
    assert open_folders() == [] and finish_all(complete=True) == []
    assert read_manifest(first.path).state == "running"


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
