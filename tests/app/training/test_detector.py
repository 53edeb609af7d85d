"""The detector's training job on synthetic crops: stages, splits, ensemble seeds, files, metrics."""

from dataclasses import replace

import numpy as np
import pytest

import app.training.detector as train_detector
from app.jobs import Workers
from app.training import crop_cycles
from app.training.crop_cycles import CalibratedNetwork
from app.training.crop_dataset import LabelledCrops
from app.training.detector import render_data_sets
from app.training.detector_config import RENDERING_SHARE, TrainDetectorConfig
from app.training.resources import Resources
from app.training.scene_dataset import Shard
from perception.detection.crop_network import create_network, load_crop_network
from perception.detection.crop_training import TrainingConfig
from perception.detection.scene_network import SceneNet, load_scene_network
from perception.io.weights import weights_checksum

TINY = TrainingConfig(epochs=1, batch=8)


def random_crops(seed):
    rng = np.random.default_rng(seed)
    n = 20
    images = rng.integers(0, 255, (n, 64, 64, 6), dtype=np.uint8)
    label = np.arange(n) % 5
    yaw, handle = rng.uniform(-3, 3, n).astype(np.float32), (np.arange(n) % 2).astype(np.float32)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), label, yaw, handle)


def one_shard(folder, split, pictures, seed, *_, **options):
    return [Shard(folder, split, seed, 0, pictures, **options)]


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch):
    """Replace rendered crops by random ones, and the trained scene network by an untrained one."""
    monkeypatch.setattr(train_detector, "load_crops", lambda shards: random_crops(len(shards)))
    monkeypatch.setattr(train_detector, "render_shards", one_shard)
    monkeypatch.setattr(train_detector, "load_scenes", lambda shards: None)
    monkeypatch.setattr(train_detector, "train_scene", lambda *_: SceneNet())


def test_the_detector_job_writes_weights_and_a_card(tmp_path):
    reported = []
    metrics = train_detector.run(
        TrainDetectorConfig(training=TINY, second=TINY),
        tmp_path,
        lambda what, share: reported.append((what, share)),
    )
    network, temperature = load_crop_network("class", tmp_path / "detector.safetensors")
    assert temperature > 0 and network.outputs == 5
    card = (tmp_path / "detector.md").read_text()
    assert "nodeslam train detector --seed 0" in card and "| mug |" in card
    assert all(weights_checksum(tmp_path / f"{name}.safetensors") in card for name in ("scene", "detector"))
    assert reported[-1] == ("epoch 1 of 1", 1.0)
    assert np.sum(metrics["confusion"]) == 20
    assert (tmp_path / "checkpoint_class.pt").is_file()
    assert (tmp_path / "second" / "checkpoint_class.pt").is_file()
    assert 0 <= metrics["accuracy_with_stacks"] <= 1
    load_scene_network(tmp_path / "scene.safetensors")


def test_training_and_validation_are_of_the_training_families_and_test_of_the_test_families(
    tmp_path, monkeypatch
):
    calls = []

    def render(folder, split, pictures, seed, workers, progress, **options):
        progress("rendering", 1.0)
        calls.append((split, pictures, seed, options))
        return []

    monkeypatch.setattr(train_detector, "render_shards", render)
    reported = []
    config = TrainDetectorConfig(
        pictures=8, further=4, validation=5, test=3, stacked=7, training=TrainingConfig(seed=11)
    )
    render_data_sets(config, tmp_path, lambda _, share: reported.append(share))
    # other seeds for validation and further crops: their shapes are not those of training
    alone, stacks = {"crops_only": True}, {"crops_only": True, "stacked": 0.5}
    assert calls == [
        ("train", 8, 11, {}), ("train", 4, 13, alone), ("train", 5, 12, {}), ("test", 3, 11, {}),
        ("train", 7, 14, stacks), ("test", 3, 14, stacks),
    ]  # fmt: skip
    shares = np.cumsum([8, 4, 5, 3, 7, 3]) / 30
    assert reported == pytest.approx(shares * RENDERING_SHARE)
    render_data_sets(replace(config, further=0, stacked=0), tmp_path, None)
    assert [split for split, *_ in calls[6:]] == ["train", "train", "test"]


def test_the_class_network_alone_learns_from_further_crops(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(train_detector, "load_crops", lambda files: loaded.append(files) or random_crops(0))
    data_sets = render_data_sets(TrainDetectorConfig(pictures=5, further=6, stacked=7), tmp_path, None)
    data_sets.crops()
    names = [[file.name for file in files] for files in loaded]
    assert names[0] == ["crops_train_seed0_n5_000.npz", "crops_train_seed2_n6_000.npz"]
    assert [name[0] for name in names[1:]] == [
        "crops_train_seed1_n300_000.npz",
        "crops_test_seed0_n300_000.npz",
        "crops_train_seed3_n7_000.npz",
        "crops_test_seed3_n300_000.npz",
    ]


def test_resources_reach_rendering_and_both_networks(tmp_path, monkeypatch):
    used = {}

    def render(folder, split, pictures, seed, workers, progress, **options):
        used["workers"] = workers
        return one_shard(folder, split, pictures, seed, **options)

    def train(task, data, config, out_dir, progress, processes, start=None):
        used["class"] = processes
        return CalibratedNetwork(create_network("class").eval(), 1.0)

    monkeypatch.setattr(train_detector, "render_shards", render)
    monkeypatch.setattr(
        train_detector, "train_scene", lambda *arguments: used.update(scene=arguments[-1]) or SceneNet()
    )
    monkeypatch.setattr(crop_cycles, "train_ensemble", train)
    config = TrainDetectorConfig(training=TINY)
    train_detector.run(config, tmp_path, None, Resources(Workers(5), processes=3))
    assert used == {"workers": Workers(5), "scene": 3, "class": 3}


def test_sets_are_used_for_training_calibration_and_evaluation(tmp_path, monkeypatch):
    """Sets differ in their sizes: training 20, validation 21, test 22, with stacks 23 and 24."""
    used = {}
    sizes = {("train", 0): 20, ("train", 1): 21, ("test", 0): 22, ("train", 3): 23, ("test", 3): 24}

    def crops(files):
        (split, seed), crops = files[0].name.split("_")[1:3], random_crops(0)
        n = sizes[split, int(seed.removeprefix("seed"))]
        return crops.subset(np.arange(n) % len(crops))

    monkeypatch.setattr(train_detector, "load_crops", crops)

    def train(task, data, *_):
        used.setdefault("training", []).append(len(data.training))
        used["validation"] = len(data.validation)
        return CalibratedNetwork(create_network("class").eval(), 1.0)

    monkeypatch.setattr(crop_cycles, "train_ensemble", train)
    metrics = train_detector.run(TrainDetectorConfig(training=TINY), tmp_path)
    assert used == {"training": [20, 23], "validation": 21} and metrics["crops"] == 22


def test_the_scenes_of_the_scene_network_are_those_for_training(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(train_detector, "load_scenes", loaded.extend)
    train_detector.run(TrainDetectorConfig(training=TINY, second=TINY, pictures=5), tmp_path)
    assert [file.name for file in loaded] == ["scenes_train_seed0_n5_000.npz"]
