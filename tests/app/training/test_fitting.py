"""Detection networks fitted by two processes: files, progress, and going on with another number of them."""

import numpy as np
import pytest
import torch

from app.training import fitting
from app.training.fitting import fit_crop_network, fit_scene_network
from app.training.scene_dataset import MAX_THINGS, LabelledScenes
from perception.detection.crop_network import create_member, predict
from perception.detection.crop_training import CropSet, TrainingConfig, TrainingData, TrainingJob
from perception.detection.scene_training import SceneTrainingConfig
from perception.distributed import Ranks


def crops(count):
    rng = np.random.default_rng(count)
    images = rng.integers(0, 255, (count, 64, 64, 6), dtype=np.uint8)
    targets = np.eye(5, dtype=np.float32)[np.arange(count) % 5]
    return CropSet(images, np.zeros((count, 2), np.float32), targets)


def scenes(count):
    rng = np.random.default_rng(0)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 0.6
    things = np.zeros((count, 64, 64), np.uint8)
    things[:, 10:30, 20:44] = 1
    return LabelledScenes(
        rng.integers(0, 255, (count, 64, 64, 3), dtype=np.uint8), np.full((count, 64, 64), 5500, np.uint16),
        things, np.zeros((count, MAX_THINGS), np.uint8), np.zeros((count, MAX_THINGS, 3)),
        np.tile([0.0, 0.0, 1.0, 0.0], (count, 1)), np.tile([70.0, 70.0, 31.5, 31.5], (count, 1)),
        np.tile(pose, (count, 1, 1)),
    )  # fmt: skip


def test_crop_networks_are_fitted_alike_and_resumed(tmp_path, monkeypatch):
    data, config = TrainingData(crops(9), crops(4)), TrainingConfig(epochs=2, batch=5)
    epochs = []

    def stop(epoch, of, metrics):
        raise KeyboardInterrupt

    torch.manual_seed(0)
    with pytest.raises(KeyboardInterrupt):  # after the checkpoint of the first epoch
        fit_crop_network("class", data, config, TrainingJob(tmp_path, progress=stop))
    job = TrainingJob(tmp_path, progress=lambda epoch, of, metrics: epochs.append((epoch, set(metrics))))
    network = fit_crop_network("class", data, config, job, processes=2)
    assert epochs == [(2, {"loss", "validation_loss", "accuracy"})] and not network.training
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint_class.pt"]
    torch.manual_seed(0)
    alone = fit_crop_network("class", data, config, TrainingJob(tmp_path / "alone"))
    images, context = data.validation.images, data.validation.context
    found, expected = (predict(net, 1.0, images, context) for net in (network, alone))
    np.testing.assert_allclose(found, expected, atol=0.03)  # bfloat16


def test_the_scene_network_is_fitted_by_several_processes(tmp_path):
    config = SceneTrainingConfig(epochs=1, batch=3, side=64)
    network = fit_scene_network(scenes(3), config, TrainingJob(tmp_path), processes=2)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint_scene.pt"] and not network.training
    alone = fit_scene_network(scenes(3), config, TrainingJob(tmp_path / "alone"))
    for name, value in alone.state_dict().items():
        torch.testing.assert_close(network.state_dict()[name], value, rtol=0.1, atol=0.02)


def test_several_processes_start_from_the_given_weights(tmp_path, monkeypatch):
    def in_this_process(function, work, processes, device, report=None):
        function(work, Ranks(), report or (lambda *_: None))

    monkeypatch.setattr(fitting, "run_on_ranks", in_this_process)
    data, start = TrainingData(crops(9), crops(4)), create_member("class")
    config = TrainingConfig(epochs=1, batch=9, learning_rate=1e-9, warmup=0.0)
    network = fit_crop_network("class", data, config, TrainingJob(tmp_path, start=start), processes=2)
    torch.testing.assert_close(network.logits.weight, start.logits.weight, rtol=0.0, atol=1e-6)


def test_one_process_starts_no_others(tmp_path, monkeypatch):
    monkeypatch.setattr(fitting, "run_on_ranks", None)
    config = TrainingConfig(epochs=1, batch=5)
    fit_crop_network("class", TrainingData(crops(5), crops(5)), config, TrainingJob(tmp_path))
