"""Cycles and ensembles of crop networks: what they start from, their seeds, folders and data."""

from dataclasses import replace

import numpy as np

from app.training import crop_cycles
from app.training.crop_cycles import CropSplits, train_cycles, train_ensemble
from app.training.crop_dataset import LabelledCrops
from app.training.detector import class_targets
from app.training.detector_config import TrainDetectorConfig
from perception.detection.crop_network import create_member
from perception.detection.crop_training import CropSet, TrainingConfig, TrainingData
from perception.detection.tasks import ENSEMBLE_SIZE, OUTPUTS

TINY = TrainingConfig(epochs=1, batch=8)


def random_crops():
    rng = np.random.default_rng(0)
    n = 20
    images = rng.integers(0, 255, (n, 64, 64, 6), dtype=np.uint8)
    label, yaw = np.arange(n) % 5, rng.uniform(-3, 3, n).astype(np.float32)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), label, yaw, np.zeros(n, np.float32))


def test_the_second_cycle_goes_on_from_the_first_on_other_crops(tmp_path, monkeypatch):
    calls, progress = [], []

    def fit(task, data, config, job, processes):
        calls.append((len(data.training), config, job, create_member(task).eval()))
        job.progress(config.epochs, config.epochs, {})
        return calls[-1][-1]

    monkeypatch.setattr(crop_cycles, "fit_crop_network", fit)
    crops = random_crops()
    splits = CropSplits(crops, crops, crops, crops.subset(np.arange(10)))
    config = TrainDetectorConfig(
        training=replace(TINY, seed=5), second=TrainingConfig(epochs=2, learning_rate=1e-4)
    )
    trained = train_cycles(
        "class", splits, class_targets, config, tmp_path, lambda _, share: progress.append(share)
    )
    (first, second), folders = calls, [job.directory for _, _, job, _ in calls]
    assert (first[0], second[0]) == (20, 10) and folders == [tmp_path, tmp_path / "second"]
    assert first[1] == config.training and second[1] == replace(config.second, seed=5)
    assert first[2].start is None and second[2].start is first[3] and trained.network is second[3]
    assert progress == [0.5, 1.0]  # as many crops in each cycle
    calls.clear()
    train_cycles("class", replace(splits, second=None), class_targets, config, tmp_path, None)
    assert len(calls) == 1


def test_members_of_an_ensemble_have_different_seeds_and_folders(tmp_path, monkeypatch):
    calls = []

    def train(task, data, config, job, processes):
        calls.append((config.seed, job.directory, processes))
        return create_member(task).eval()

    monkeypatch.setattr(crop_cycles, "fit_crop_network", train)
    monkeypatch.setitem(ENSEMBLE_SIZE, "class", 2)
    crops = class_targets(random_crops())
    data = TrainingData(crops, crops)
    config = TrainDetectorConfig(training=TrainingConfig(seed=3))
    train_ensemble("class", data, config, tmp_path, None, 2)
    assert calls == [(3, tmp_path, 2), (4, tmp_path / "member1", 2)]


def test_only_networks_of_classes_are_freed_from_frequencies(tmp_path, monkeypatch):
    freed = []
    monkeypatch.setattr(crop_cycles, "equalise_priors", lambda network, targets: freed.append(len(targets)))
    monkeypatch.setattr(crop_cycles, "fit_crop_network", lambda task, *_: create_member(task).eval())
    for task in ("class", "yaw"):
        targets = np.eye(OUTPUTS[task], dtype=np.float32)[np.zeros(4, int)]
        crops = CropSet(np.zeros((4, 64, 64, 6), np.uint8), np.zeros((4, 2), np.float32), targets)
        train_ensemble(task, TrainingData(crops, crops), TrainDetectorConfig(training=TINY), tmp_path, None)
    assert freed == [4]
