"""Whole commands: packing and sorting in simulation with the shipped networks, scored on ground truth."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from perception.io.object_map import read_object_map

ROOT = Path(__file__).parents[1]
MIN_SUCCESS_RATE = 0.8  # of the objects over all seeds
STAGES = {"scan", "detect", "reconstruct", "plan", "execute", "verify", "total"}

# Runs `nodeslam` as on a machine without a simulator.
WITHOUT_SIMULATOR = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"mujoco", "mink", "ruckig", "daqp", "coacd", "open3d"}:
            raise ModuleNotFoundError(f"{name} is blocked", name=name)
sys.meta_path.insert(0, Block())
from app.cli import run
sys.exit(run(sys.argv[1:]))
"""


def nodeslam(*arguments, program=("-m", "app")):
    command = [sys.executable, *program, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)


def episode(task, seed, out, *options):
    """The report of one run, its exit code checked."""
    done = nodeslam(task, "--objects", 4, "--seed", seed, "--out", out, "--json", *options)
    assert done.returncode in (0, 1), done.stderr
    report = json.loads(done.stdout)
    assert done.returncode == (0 if report["success"] else 1)
    assert report == json.loads((out / "report.json").read_text())
    return report


def check(reports):
    objects = [entry for report in reports for entry in report["objects"]]
    placed = sum(entry["placed"] for entry in objects)
    assert len(objects) == 4 * len(reports)
    assert placed >= MIN_SUCCESS_RATE * len(objects), [report["reason"] for report in reports]
    for report in reports:
        assert set(report["timings"]) == STAGES
        for row in report["metrics"]["reconstruction"]:
            assert row["found"] and row["accuracy"] < 0.006, row


def test_packing_and_reconstruction_of_its_scan_without_a_simulator(tmp_path):
    first = tmp_path / "1"
    check([episode("pack", 1, first)])
    for name in ("objects.json", "plan.json", "replay.npz", "overview.png", "scan/scene_camera.json"):
        assert (first / name).stat().st_size > 0
    again = tmp_path / "again"
    done = nodeslam("reconstruct", first / "scan", "--out", again, program=("-c", WITHOUT_SIMULATOR))
    assert done.returncode == 0, done.stderr
    for a, b in zip(read_object_map(first), read_object_map(again), strict=True):
        assert a.name == b.name
        # The images on disk hold depth in tenths of a millimetre.
        np.testing.assert_allclose(a.T_world_object[:3, 3], b.T_world_object[:3, 3], atol=0.003)


def test_sorting(tmp_path):
    check([episode("sort", 1, tmp_path / "1")])


@pytest.mark.slow
@pytest.mark.parametrize("task", ["pack", "sort"])
def test_further_seeds(task, tmp_path):
    check([episode(task, seed, tmp_path / str(seed)) for seed in range(2, 6)])


def test_an_object_that_cannot_be_packed_is_named(tmp_path):
    report = episode("pack", 3, tmp_path / "run", "--box", "0.12,0.10,0.08", "--shapes", "oracle")
    assert not report["success"]
    assert any("box too small" in entry["reason"] for entry in report["objects"])


def test_too_many_objects_for_the_region_are_refused(tmp_path):
    region = ("--region", "0.4,0.5,-0.2,-0.1")
    done = nodeslam("pack", "--objects", "bowl=6", *region, "--out", tmp_path / "run")
    assert done.returncode == 2
    assert "objects do not fit on the table" in done.stderr.splitlines()[-1]
