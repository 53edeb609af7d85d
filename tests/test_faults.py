"""Faults from outside: full disks while anything is written, and signals at any moment of a command."""

import os
import resource
import shutil
from contextlib import contextmanager

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
from app.runs.replay import Recorder, read_recording
from app.runs.report import Report
from app.runs.run_folder import PREVIOUS, RunFolder, finish_all
from perception.io.files import write_atomically
from perception.io.object_map import read_object_map, write_object_map
from perception.io.scan_folder import read_scan, write_scan
from perception.types import CameraIntrinsics, ObjectEstimate, RgbdFrame, SupportPlane, TriangleMesh
from tests.fuzzing import SHORT
from tests.kills import Campaign

KILLS = int(os.environ.get("NODESLAM_KILLS", "60"))


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


@pytest.mark.slow
def test_killed_at_any_moment_nothing_is_lost_and_nothing_is_half_written(tmp_path):
    """The first kills of the campaign of all commands: ``python -m tests.kills``."""
    campaign = Campaign(tmp_path, ["doctor", "glb", "urdf", "scan", "reconstruct", "ar"])
    for number in range(KILLS):
        row = campaign.kill(number)
        assert not row["problem"], row
