"""The axis network's training job on synthetic crops, and its metrics."""

import numpy as np
import pytest

import app.training.axis as train_axis
import app.training.pose as train_pose
from app.training.crop_dataset import LabelledCrops
from perception.detection.crop_network import load_crop_network
from perception.detection.crop_training import TrainingConfig
from perception.detection.yaw import modes, soft_labels
from perception.types import POSED_CLASSES


def random_crops(seed):
    rng = np.random.default_rng(seed)
    label = np.arange(30) % 10
    images = rng.integers(0, 255, (30, 64, 64, 6), dtype=np.uint8)
    yaw = rng.uniform(-3, 3, 30).astype(np.float32)
    return LabelledCrops(images, np.zeros((30, 2), np.float32), label, yaw, np.zeros(30, np.float32))


def test_the_job_learns_from_what_lies_and_writes_weights_and_card(tmp_path, monkeypatch):
    monkeypatch.setattr(train_pose, "load_crops", lambda paths: random_crops(len(paths)))
    monkeypatch.setattr(train_pose, "render_shard", lambda shard: (b"",))
    config = train_axis.TrainAxisConfig(
        pictures=5, validation=5, test=5, training=TrainingConfig(epochs=1, batch=8)
    )
    metrics = train_axis.run(config, tmp_path)
    network, _ = load_crop_network("axis", tmp_path / "axis.safetensors")
    assert network.outputs == 36 and metrics["crops"] == 9
    assert [metrics[name]["crops"] for name in ("mug", "bottle", "can", "all")] == [3, 3, 3, 9]
    card = (tmp_path / "axis.md").read_text()
    assert "the 9 crops of lying mugs" in card and "| bottle | 3 |" in card and "SHA-256" in card


def test_targets_peak_at_the_direction_of_what_lies():
    crops = train_axis.select_lying(random_crops(1))
    assert {POSED_CLASSES[k][1] for k in crops.label} == {"lying"} and len(crops) == 9
    for target, yaw in zip(train_axis.axis_targets(crops).targets.astype(np.float64), crops.yaw):
        error = (modes(target)[0][0] - yaw + np.pi) % (2 * np.pi) - np.pi
        assert abs(error) < np.radians(2)


def test_metrics_count_what_is_the_right_way_round():
    """A third of the directions are reversed, and the network is not sure of these."""
    crops = train_axis.select_lying(random_crops(0))
    true = soft_labels(crops.yaw.astype(np.float64)).astype(np.float64)
    assert train_axis.axis_metrics(crops, true)["all"] == {
        "crops": 9, "right": 1.0, "sure": 1.0, "right_if_sure": 1.0
    }  # fmt: skip
    reversed_ = 0.4 * true + 0.6 * np.roll(true, 18, axis=1)
    wrong = np.arange(9)[:, None] % 3 == 0
    figures = train_axis.axis_metrics(crops, np.where(wrong, reversed_, true))["all"]
    assert figures["right"] == figures["sure"] == pytest.approx(2 / 3)
    assert figures["right_if_sure"] == 1.0
