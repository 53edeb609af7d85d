"""The training jobs end to end on crops made up here, and the figures they report."""

import numpy as np
import pytest

import app.training.detector as train_detector
import app.training.yaw as train_yaw
from app.training.crop_dataset import LabelledCrops
from app.training.files import summary_writer
from perception.detection.crop_network import load_crop_network
from perception.detection.crop_training import TrainingConfig
from perception.detection.scene_network import SceneNet, load_scene_network
from perception.detection.yaw import soft_labels
from perception.errors import PerceptionError
from perception.io.weights import weights_checksum

TINY = TrainingConfig(epochs=1, batch=8)


def made_up(seed):
    rng = np.random.default_rng(seed)
    n = 20
    images = rng.integers(0, 255, (n, 64, 64, 6), dtype=np.uint8)
    label = np.arange(n) % 5
    yaw, handle = rng.uniform(-3, 3, n).astype(np.float32), (np.arange(n) % 2).astype(np.float32)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), label, yaw, handle)


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch):
    """A shard is its number; what is in it is made up, and the scene network is not trained."""
    monkeypatch.setattr(train_detector, "load_crops", lambda shards: made_up(len(shards)))
    monkeypatch.setattr(
        train_detector, "render_crop_shards", lambda folder, split, n, seed, *_, **__: [folder] * (1 + seed)
    )
    monkeypatch.setattr(train_detector, "load_scenes", lambda shards: None)
    monkeypatch.setattr(train_detector, "train_scene", lambda *_: SceneNet())
    monkeypatch.setattr(train_detector, "render_scene_shards", lambda folder, *_: [folder])


def test_the_detector_job_writes_weights_and_a_card(tmp_path):
    told = []
    metrics = train_detector.run(
        train_detector.TrainDetectorConfig(training=TINY),
        tmp_path,
        lambda what, share: told.append((what, share)),
    )
    network, temperature = load_crop_network("class", tmp_path / "detector.safetensors")
    assert temperature > 0 and network.outputs == 5
    card = (tmp_path / "detector.md").read_text()
    assert "nodeslam train detector --seed 0" in card and "| mug |" in card
    assert all(weights_checksum(tmp_path / f"{name}.safetensors") in card for name in ("scene", "detector"))
    assert told[-1] == ("epoch 2 of 2", 1.0)
    assert np.sum(metrics["confusion"]) == 20
    assert (tmp_path / "checkpoint_class.pt").is_file()
    assert (tmp_path / "member1" / "checkpoint_class.pt").is_file()
    load_scene_network(tmp_path / "scene.safetensors")


def test_the_yaw_job_learns_from_mugs_alone(tmp_path):
    metrics = train_yaw.run(train_yaw.TrainYawConfig(training=TINY), tmp_path)
    load_crop_network("yaw", tmp_path / "yaw.safetensors")
    assert metrics["mugs"] == 4
    assert metrics["visible"]["mugs"] == 2 and metrics["hidden"]["mugs"] == 2
    assert "| visible | 2 |" in (tmp_path / "yaw.md").read_text()


def test_tensorboard_missing_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "torch.utils.tensorboard", None)
    with pytest.raises(PerceptionError, match=r"pip install '\.\[train\]'"):
        summary_writer(tmp_path)


def test_class_figures_by_hand():
    crops = made_up(0)
    probabilities = np.full((20, 5), 0.05)
    probabilities[np.arange(20), crops.label] = 0.8
    probabilities[4] = (0.8, 0.05, 0.05, 0.05, 0.05)  # a distractor taken for a mug
    metrics = train_detector.class_metrics(crops, probabilities)
    assert metrics["accuracy"] == 0.95 and metrics["accuracy_objects"] == 1.0
    assert metrics["distractors_taken_for_objects"] == 0.25
    assert metrics["confusion"][4] == [1, 0, 0, 0, 3]
    assert metrics["calibration_error"] == pytest.approx(0.15)


def test_yaw_figures_by_hand():
    crops = train_yaw.select_mugs(made_up(0))
    off = crops.yaw.astype(np.float64) + np.radians([0, 20, 0, 40])
    metrics = train_yaw.yaw_metrics(crops, soft_labels(off))
    both = [metrics["visible"], metrics["hidden"]]
    assert sum(m["over_15_degrees"] * m["mugs"] for m in both) == pytest.approx(2)
    assert sum(m["over_30_degrees"] * m["mugs"] for m in both) == pytest.approx(1)
    right = train_yaw.yaw_metrics(crops, soft_labels(crops.yaw.astype(np.float64)))
    assert right["visible"]["median"] < np.radians(1)
