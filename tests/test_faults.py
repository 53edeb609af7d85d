"""Faults from outside: full disks while anything is written, and signals at any moment of a command."""

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from app.evaluation.ledger import Ledger, LedgerFormat
from app.export.glb import glb_bytes
from app.export.mjcf import write_mjcf
from app.export.model import rigid_model
from app.options import EvaluateOptions, ExportOptions
from app.runs.manifest import MANIFEST_FILE
from app.runs.replay import Recorder, read_recording
from app.runs.report import Report
from app.runs.run_folder import PREVIOUS, RunFolder, finish_all
from perception.io.files import write_atomically
from perception.io.object_map import read_object_map, write_object_map
from perception.io.scan_folder import read_scan, write_scan
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, SupportPlane, TriangleMesh
from tests.fuzzing import SHORT

KILLS = int(os.environ.get("NODESLAM_KILLS", "200"))


@contextmanager
def disk_of(n_bytes):
    """Let every file of this process end at a size, as on a full disk: further writes raise OSError."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def a_can(x=0.0):
    mesh = trimesh.creation.cylinder(0.03, 0.1, sections=16)
    T = np.eye(4)
    T[:3, 3] = (x, 0.0, 0.05)
    return ObjectEstimate(
        0, "can", np.zeros(16), T, np.full(3, 0.055), TriangleMesh(mesh.vertices, mesh.faces)
    )


def a_frame():
    rgb = np.random.default_rng(0).integers(0, 255, (24, 32, 3), dtype=np.uint8)
    intrinsics = CameraIntrinsics(32, 24, 30.0, 30.0, 15.5, 11.5)
    return RgbdFrame(0.0, rgb, np.full((24, 32), 0.5, np.float32), intrinsics, np.eye(4))


def a_recording():
    recorder = Recorder(bodies=("hand",))
    for step in range(40):
        recorder.sample(0.1 * step, np.full(7, step / 7), 0.04, np.full((1, 7), 0.5))
    recorder.note("stage", name="scan")
    return recorder


# Writers, each with its reader, if there is one, and the file that it writes last.
WRITERS = {
    "scan": (lambda folder: write_scan(folder, [a_frame()] * 2), read_scan, "scene_camera.json"),
    "object map": (lambda folder: write_object_map(folder, [a_can()]), read_object_map, "objects.json"),
    "recording": (lambda folder: a_recording().write(folder), read_recording, "replay.json"),
    "glb": (lambda folder: write_atomically(folder / "scene.glb", glb_bytes([a_can()])), None, "scene.glb"),
    "mjcf": (
        lambda folder: write_mjcf(folder, [rigid_model(a_can())], SupportPlane(np.array([0, 0, 1.0]), 0.0)),
        None,
        "scene.xml",
    ),
}


@pytest.mark.parametrize("name", WRITERS)
@SHORT
@given(n_bytes=st.integers(0, 4000))
def test_a_full_disk_leaves_nothing_half_written(tmp_path, name, n_bytes):
    write, read, last = WRITERS[name]
    folder = tmp_path / f"{n_bytes}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        with disk_of(n_bytes):
            write(folder)
    except OSError:
        assert not (folder / last).exists(), "the file that makes the rest valid is written last"
    else:
        assert (folder / last).exists()
        if read is not None:
            read(folder)
    assert not [path.name for path in folder.rglob(".*")], "temporary files"


@SHORT
@given(n_bytes=st.integers(0, 600))
def test_a_full_disk_costs_a_ledger_at_most_the_line_being_written(tmp_path, n_bytes):
    out = tmp_path / "out"
    with RunFolder.create(EvaluateOptions(what="tasks", out=out), "evaluate-tasks") as folder:
        ledger = Ledger(folder, out / "rows.jsonl", LedgerFormat("evaluate-tasks", "rows.jsonl", "seed"))
        ledger.path.unlink(missing_ok=True)
        written = 0
        try:
            with disk_of(n_bytes):
                for seed in range(10):
                    ledger.append({"seed": seed, "reason": "x" * 50})
                    written += 1
        except OSError:
            pass
        found = list(ledger.read())
        assert found == list(range(len(found)))
        assert len(found) in (written, written + 1), "of the last line, the line break alone may be missing"


@pytest.mark.parametrize("n_bytes", [0, 50, 150, 300, 1000])
def test_a_full_disk_never_costs_the_run_that_was_there(tmp_path, n_bytes):
    out = tmp_path / "out"
    with RunFolder.create(ExportOptions(run=tmp_path / "run", out=out), "export") as folder:
        write_atomically(out / "scene.glb", b"old" * 100)
        folder.write_report(Report("export", 0, success=True))
    try:
        with disk_of(n_bytes):
            RunFolder.create(ExportOptions(run=tmp_path / "run", out=out), "export")
            write_atomically(out / "scene.glb", b"new" * 1000)
            finish_all(complete=True)
    except Exception as error:
        assert isinstance(error, OSError) or "cannot be written" in str(error)
    finish_all(complete=False)
    kept = [path for path in (out / "scene.glb", out / PREVIOUS / "scene.glb") if path.exists()]
    assert [path.read_bytes() for path in kept] in ([b"old" * 100], [b"new" * 1000])


# ---------------------------------------------------------------- signals at any moment


def environment():
    return os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "OPENBLAS_NUM_THREADS": "1"}


def command_line(*arguments):
    return [sys.executable, "-m", "app", *map(str, arguments), "--quiet"]


def contents(folder):
    """Return the files of a folder but for the program's notes about them."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith((MANIFEST_FILE, f".{MANIFEST_FILE}", ".nodeslam.lock"))
    }


def processes_of(group):
    """Return the ids of the processes of a group that are still alive."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = status.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(its_group) == group and state != "Z":
            found.append(status.parent.name)
    return found


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    arguments = ("scan", "--objects", "can=1", "--seed", 3, "--out", folder / "run")
    subprocess.run(command_line(*arguments), env=environment(), check=True, timeout=600)
    arguments = ("reconstruct", folder / "run" / "scan", "--out", folder / "map")
    subprocess.run(command_line(*arguments), env=environment(), check=True, timeout=600)
    return folder


@pytest.mark.slow
def test_killed_at_any_moment_nothing_is_lost_and_nothing_is_half_written(finished_run, tmp_path):
    """Each command replaces a run of its own; moments and signals are drawn with a fixed seed."""
    commands = {
        "doctor": ("doctor",),
        "glb": ("export", finished_run / "map"),
        "urdf": ("export", finished_run / "map", "--format", "urdf"),
        "scan": ("scan", "--objects", "can=1", "--seed", 4),
        "reconstruct": ("reconstruct", finished_run / "run" / "scan"),
        "ar": ("ar", finished_run / "map", "--drops", 1, "--seconds", 0.2),
    }
    rng = random.Random(0)
    seconds, old = {}, {}
    for name, arguments in commands.items():
        begin = time.perf_counter()
        subprocess.run(
            command_line(*arguments, "--out", tmp_path / f"{name}_old"), env=environment(), timeout=900
        )
        seconds[name] = time.perf_counter() - begin
        (tmp_path / f"{name}_old" / "notes.txt").write_text("a person's")
        old[name] = contents(tmp_path / f"{name}_old")
    for number in range(KILLS):
        name = rng.choice(list(commands))
        how = rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
        out = tmp_path / f"{number}"
        shutil.copytree(tmp_path / f"{name}_old", out)
        process = subprocess.Popen(
            command_line(*commands[name], "--out", out), env=environment(), stderr=subprocess.PIPE, text=True,
            start_new_session=True,
        )  # fmt: skip
        time.sleep(rng.uniform(0, 1.1 * seconds[name]))
        process.send_signal(how)
        _, error = process.communicate(timeout=120)
        where = f"{number}: {name} ended by {how.name}, {error}"
        assert "Traceback" not in error and len(error.splitlines()) <= 1, where
        check_nothing_is_lost(out, old[name], where, complete=process.returncode in (0, 1))
        time.sleep(0.2)
        assert not processes_of(process.pid), where
        if number % 20 == 0:
            again = subprocess.run(
                command_line(*commands[name], "--out", out), env=environment(), timeout=900
            )
            assert again.returncode in (0, 1) and contents(out).keys() == old[name].keys(), where
        shutil.rmtree(out)


def check_nothing_is_lost(out, old, where, complete):
    """Each old file is where it was, or in the folder of the replaced run, or all of them were replaced."""
    for path in out.rglob("*.json"):
        json.loads(path.read_text())
    now = contents(out)
    assert now["notes.txt"] == b"a person's", where
    if not complete:
        lost = [name for name in old if old[name] not in (now.get(name), now.get(f"{PREVIOUS}/{name}"))]
        assert not lost or f"{PREVIOUS}/{lost[0]}" not in now, where
        replaced = json.loads((out / MANIFEST_FILE).read_text())["state"] == "complete"
        assert not lost or replaced, f"{where}: {lost}"
