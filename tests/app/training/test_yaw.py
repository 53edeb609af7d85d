"""The yaw network's training job on synthetic crops, and its metrics."""

import numpy as np
import pytest

import app.training.detector as train_detector
import app.training.yaw as train_yaw
from app.training.crop_dataset import LabelledCrops
from app.training.detector_config import RENDERING_SHARE
from app.training.scene_dataset import Shard
from perception.detection.crop_network import load_crop_network
from perception.detection.crop_training import TrainingConfig
from perception.detection.scene_network import SceneNet
from perception.detection.yaw import modes, soft_labels

TINY = TrainingConfig(epochs=1, batch=8)


def random_crops(seed):
    rng = np.random.default_rng(seed)
    n = 20
    images = rng.integers(0, 255, (n, 64, 64, 6), dtype=np.uint8)
    label = np.arange(n) % 5
    yaw, handle = rng.uniform(-3, 3, n).astype(np.float32), (np.arange(n) % 2).astype(np.float32)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), label, yaw, handle)


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch):
    """Replace rendered crops by random ones, and the trained scene network by an untrained one."""
    monkeypatch.setattr(train_detector, "load_crops", lambda shards: random_crops(len(shards)))
    monkeypatch.setattr(
        train_detector,
        "render_shards",
        lambda folder, split, n, seed, *_, **__: [Shard(folder, split, seed, 0, n)],
    )
    monkeypatch.setattr(train_detector, "load_scenes", lambda shards: None)
    monkeypatch.setattr(train_detector, "train_scene", lambda *_: SceneNet())
    monkeypatch.setattr(train_yaw, "load_crops", lambda shards: random_crops(7))
    monkeypatch.setattr(
        train_yaw,
        "render_shards",
        lambda folder, split, n, seed, *_, **__: [Shard(folder, split, seed, 0, n)],
    )


def test_the_yaw_job_learns_from_mugs_alone(tmp_path):
    metrics = train_yaw.run(train_yaw.TrainYawConfig(training=TINY, second=TINY), tmp_path)
    load_crop_network("yaw", tmp_path / "yaw.safetensors")
    for figures in (metrics, metrics["bodies"]):
        assert figures["mugs"] == 4
        assert figures["visible"]["mugs"] == 2 and figures["hidden"]["mugs"] == 2
    card = (tmp_path / "yaw.md").read_text()
    assert "| visible | 2 |" in card and "| visible (as in the second cycle) | 2 |" in card
    assert "4 crops of 6000 other images" in card


def test_without_scenes_of_mugs_there_is_one_cycle(tmp_path):
    config = train_yaw.TrainYawConfig(mugs=0)
    crops = train_yaw.mug_crops(config, tmp_path, None)
    assert crops.second is None and len(crops.training) == 4


def test_more_mugs_are_rendered_for_the_second_cycle(tmp_path, monkeypatch):
    calls, reported = [], []

    def render(folder, split, pictures, seed, workers, progress, **options):
        progress("rendering", 1.0)
        calls.append((split, pictures, seed, options))
        return [Shard(folder, split, seed, 0, pictures)]

    monkeypatch.setattr(train_detector, "render_shards", render)
    monkeypatch.setattr(train_yaw, "render_shards", render)
    training = TrainingConfig(seed=11)
    config = train_yaw.TrainYawConfig(pictures=8, validation=5, test=3, mugs=6, training=training)
    train_yaw.mug_crops(config, tmp_path, lambda _, share: reported.append(share))
    mugs = {"crops_only": True, "stacked": 0.5, "mugs": True}
    assert [call[:3] for call in calls[:3]] == [("train", 8, 11), ("train", 5, 12), ("test", 3, 11)]
    assert calls[3:] == [("train", 6, 15, mugs), ("test", 3, 15, mugs)]
    assert reported == pytest.approx(RENDERING_SHARE * np.cumsum([8, 5, 3, 6, 3]) / 25)


def test_yaw_metrics_of_known_errors():
    crops = train_yaw.select_mugs(random_crops(0))
    off = crops.yaw.astype(np.float64) + np.radians([0, 20, 0, 40])
    metrics = train_yaw.yaw_metrics(crops, soft_labels(off))
    both = [metrics["visible"], metrics["hidden"]]
    assert sum(m["over_15_degrees"] * m["mugs"] for m in both) == pytest.approx(2)
    assert sum(m["over_30_degrees"] * m["mugs"] for m in both) == pytest.approx(1)
    right = train_yaw.yaw_metrics(crops, soft_labels(crops.yaw.astype(np.float64)))
    assert right["visible"]["median"] < np.radians(1)


@pytest.mark.parametrize(
    ("a", "b", "expected"), [(0.1, 0.4, 0.3), (3.0, -3.0, 2 * np.pi - 6), (0, np.pi, np.pi), (7, 7, 0)]
)
def test_the_difference_of_angles_is_at_most_half_a_turn(a, b, expected):
    assert train_yaw.angle_between(a, b) == pytest.approx(expected)
    assert train_yaw.angle_between(b, a) == pytest.approx(expected)


def test_targets_peak_at_the_true_yaw():
    crops = train_yaw.select_mugs(random_crops(1))
    assert (crops.label == 0).all() and len(crops) == 4
    targets = train_yaw.yaw_targets(crops).targets
    for target, yaw in zip(targets.astype(np.float64), crops.yaw):
        assert train_yaw.angle_between(modes(target)[0][0], float(yaw)) < np.radians(1)


def test_a_second_mode_counts_for_the_closest_only():
    crops = train_yaw.select_mugs(random_crops(0))
    wrong = soft_labels(crops.yaw.astype(np.float64) + np.pi)
    right = soft_labels(crops.yaw.astype(np.float64))
    metrics = train_yaw.yaw_metrics(crops, (0.7 * wrong + 0.3 * right).astype(np.float64))
    for name in ("visible", "hidden"):
        assert metrics[name]["over_30_degrees"] == 1.0
        assert metrics[name]["no_mode_within_30_degrees"] == 0.0


def test_a_handle_is_visible_from_one_percent_of_the_points():
    crops = train_yaw.select_mugs(random_crops(0))
    shares = np.array([0.0, 0.0099, 0.01, 0.5], np.float32)
    shares[2] = 0.0101
    changed = LabelledCrops(crops.images, crops.context, crops.label, crops.yaw, shares)
    metrics = train_yaw.yaw_metrics(changed, soft_labels(crops.yaw.astype(np.float64)).astype(np.float64))
    assert (metrics["visible"]["mugs"], metrics["hidden"]["mugs"]) == (2, 2)
