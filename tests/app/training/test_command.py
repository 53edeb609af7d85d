"""Configuration and report of `nodeslam train`."""

import json
from pathlib import Path

import pytest

from app.errors import UsageError
from app.options import TrainOptions
from app.screen import Screen
from app.training import command


@pytest.mark.parametrize("network", ["shape", "detector", "yaw"])
def test_options_reach_the_job(network, tmp_path, monkeypatch):
    _, default = command._job(TrainOptions(network=network))
    jobs = []

    def train(config, folder: Path, progress):
        jobs.append(config)
        progress("epoch 1", 0.5)
        return {"skipped": ["odd.ply: not watertight"]}

    monkeypatch.setattr(command, "_job", lambda options: (train, default))
    options = TrainOptions(network=network, epochs=3, seed=11, out=tmp_path, device="cpu", quiet=True)
    report = command.run(options, Screen(quiet=True))
    (config,) = jobs
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
