"""Configuration and report of `nodeslam train`."""

import json
import os
from pathlib import Path

import pytest

from app.errors import UsageError
from app.jobs import Workers
from app.options import TrainOptions
from app.screen import Screen
from app.training import command
from app.training.resources import Resources


@pytest.mark.parametrize("network", ["shape", "detector", "yaw", "pose", "axis"])
def test_options_reach_the_job(network, tmp_path, monkeypatch):
    _, default = command._job(TrainOptions(network=network))
    jobs = []

    def train(config, folder: Path, progress, resources):
        jobs.append((config, resources))
        progress("epoch 1", 0.5)
        return {"skipped": ["odd.ply: not watertight"]}

    monkeypatch.setattr(command, "_job", lambda options: (train, default))
    options = TrainOptions(
        network=network, epochs=3, seed=11, out=tmp_path, device="cpu", quiet=True, workers=7, ray="auto",
        processes=3,
    )  # fmt: skip
    report = command.run(options, Screen(quiet=True))
    ((config, resources),) = jobs
    assert resources == Resources(Workers(7, ray="auto"), processes=3)
    assert (config.training.epochs, config.training.seed, config.device) == (3, 11, "cpu")
    assert report.success and report.settings == {"network": network, "device": "cpu", "epochs": 3}
    stored = json.loads((tmp_path / "report.json").read_text())
    assert stored["warnings"] == ["odd.ply: not watertight"] and stored["seed"] == 11


def test_epochs_are_the_jobs_own_by_default(tmp_path, monkeypatch):
    _, default = command._job(TrainOptions(network="yaw"))
    jobs = []
    monkeypatch.setattr(command, "_job", lambda _: (lambda config, *_: jobs.append(config) or {}, default))
    command.run(TrainOptions(network="yaw", out=tmp_path, device="cpu", quiet=True), Screen(quiet=True))
    assert jobs[0].training.epochs == default.training.epochs


@pytest.mark.parametrize("change", [{"meshes": Path("dir")}, {"tensorboard": True}])
def test_options_of_shapes_are_refused_for_other_networks(change, tmp_path):
    with pytest.raises(UsageError, match="are for `train shape`, not `train yaw`"):
        command.run(TrainOptions(network="yaw", out=tmp_path, device="cpu", **change), Screen(quiet=True))


def test_data_are_generated_on_all_cores_by_default(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert command._resources(TrainOptions(network="yaw"), "cpu") == Resources(Workers(6), processes=1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"workers": 0}, "--workers 0: at least one is needed"),
        ({"processes": 0}, "--processes 0: at least one is needed"),
        ({"network": "acceptance", "processes": 2}, "--processes is not for `train acceptance`"),
        ({"network": "verifier", "processes": 2}, "--processes is not for `train verifier`"),
    ],
)
def test_impossible_numbers_of_processes_are_refused(change, message, tmp_path):
    options = TrainOptions(**{"network": "yaw", "out": tmp_path / "out", "device": "cpu"} | change)
    with pytest.raises(UsageError, match=message):
        command.run(options, Screen(quiet=True))
    assert not (tmp_path / "out").exists()
