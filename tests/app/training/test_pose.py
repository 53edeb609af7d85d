"""The pose network's training job on synthetic crops: labels, shards and metrics."""

from pathlib import Path

import numpy as np
import pytest

import app.training.pose as train_pose
from app.training.crop_dataset import LabelledCrops
from perception.detection.crop_network import load_crop_network
from perception.detection.crop_training import TrainingConfig
from perception.detection.tasks import POSE_LABELS
from perception.errors import PerceptionError
from perception.types import POSED_CLASSES
from sim_assets.datasets.labels import InstanceLabel


def item(category, resting="upright"):
    return InstanceLabel(category, np.eye(4), 500, 600.0, 0.1, np.zeros(3), resting != "upright", resting)


def random_crops(seed):
    rng = np.random.default_rng(seed)
    label = np.arange(20) % len(POSE_LABELS)
    images = rng.integers(0, 255, (20, 64, 64, 6), dtype=np.uint8)
    nothing = np.zeros(20, np.float32)
    return LabelledCrops(images, np.zeros((20, 2), np.float32), label, nothing, nothing)


def test_labels_are_classes_in_resting_poses():
    labels = [train_pose.pose_index(item(*posed)) for posed in POSED_CLASSES]
    assert labels == list(range(9))
    assert train_pose.pose_index(item(None)) == train_pose.pose_index(None) == 9
    assert POSE_LABELS[labels[1]] == "mug upside-down" and POSE_LABELS[9] == "other"


def test_the_pose_job_writes_weights_and_card(tmp_path, monkeypatch):
    monkeypatch.setattr(train_pose, "load_crops", lambda paths: random_crops(len(paths)))
    rendered = []

    def render(shard):
        rendered.append((shard.split, shard.seed, shard.count, shard.has_stacks))
        return (b"",)

    monkeypatch.setattr(train_pose, "render_shard", render)
    tiny = TrainingConfig(epochs=1, batch=8)
    config = train_pose.TrainPoseConfig(
        pictures=5, validation=4, test=6, stacked=7, training=tiny, second=tiny
    )
    metrics = train_pose.run(config, tmp_path)
    first = [("train", 0, 5, False), ("train", 1, 4, False), ("test", 0, 6, False)]
    assert rendered == [*first, ("train", 3, 7, True), ("test", 3, 6, True)]
    assert 0 <= metrics["accuracy_with_stacks"] <= 1 and (tmp_path / "second").is_dir()
    network, _ = load_crop_network("pose", tmp_path / "pose.safetensors")
    assert network.outputs == 10 and metrics["crops"] == 20
    card = (tmp_path / "pose.md").read_text()
    assert "| bowl upside-down |" in card and "SHA-256" in card
    assert "20 crops of 7 other images, 50%" in card


def test_shards_are_rendered_once_and_a_failed_one_is_an_error(tmp_path, monkeypatch):
    rendered = []

    def render(shard):
        rendered.append(shard.number)
        return (b"crops",)

    monkeypatch.setattr(train_pose, "render_shard", render)
    shards = train_pose.render_crops(tmp_path, "train", 250, seed=3)
    assert [shard.count for shard in shards] == [100, 100, 50]
    shards[1].path.unlink()
    train_pose.render_crops(tmp_path, "train", 250, seed=3)
    assert rendered == [0, 1, 2, 1] and shards[1].path.read_bytes() == b"crops"
    monkeypatch.setattr(train_pose, "render_shard", lambda shard: 1 / 0)
    with pytest.raises(PerceptionError, match="rendering test scenes: shard 0 crashed: ZeroDivisionError"):
        train_pose.render_crops(tmp_path, "test", 250, seed=3)


@pytest.mark.slow
def test_a_shard_has_objects_in_all_poses(tmp_path: Path):
    shard = train_pose.PoseShard(tmp_path / "crops.npz", "train", 0, 0, 16)
    (content,) = train_pose.render_shard(shard)
    shard.path.write_bytes(content)
    labels = LabelledCrops.load(shard.path).label
    assert set(range(10)) == set(labels.tolist())


def test_metrics_of_known_answers():
    crops = random_crops(0)
    sure = np.eye(10)[crops.label]
    assert train_pose.pose_metrics(crops, sure)["accuracy"] == 1.0
    turned = sure[:, [1, 0, *range(2, 10)]]  # upright mugs and those upside down are confused
    metrics = train_pose.pose_metrics(crops, turned)
    assert metrics["accuracy"] == pytest.approx(16 / 20)
    assert metrics["accuracy_per_pose"]["mug upright"] == 0.0
    assert metrics["confusion"][0][1] == 2 and metrics["confusion"][5][5] == 2
    assert train_pose.pose_targets(crops).targets.shape == (20, 10)
