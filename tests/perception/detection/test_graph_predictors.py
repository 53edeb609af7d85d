"""The networks with ONNX Runtime predict the same as with PyTorch."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch.nn import functional

from perception.detection.crop_network import CropNet, create_network, normalise_crops, save_crop_network
from perception.detection.graph_predictors import (
    GraphCropPredictor,
    GraphScenePredictor,
    halve_resolution,
    normalised_crops,
)
from perception.detection.tasks import OUTPUTS, SCENE_OUTPUTS, TRAINED_BY
from perception.detection.torch_predictors import TorchCropPredictor, TorchScenePredictor
from perception.detection.weights import save_weights
from perception.detection.working_view import CHANNELS
from perception.errors import PerceptionError


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def random_crops(count, rng):
    images = rng.integers(0, 256, (count, 64, 64, 6), dtype=np.uint8)
    return images, rng.standard_normal((count, 2)).astype(np.float32)


def test_each_block_of_pixels_becomes_channels_as_by_pixel_unshuffle(rng):
    image = rng.random((6, 4, 3), dtype=np.float32)
    expected = functional.pixel_unshuffle(torch.from_numpy(image).permute(2, 0, 1)[None], 2)[0]
    np.testing.assert_array_equal(halve_resolution(image), expected.numpy())


def test_crops_are_normalised_as_for_training(rng):
    images, _ = random_crops(2, rng)
    expected = normalise_crops(torch.from_numpy(images)).numpy()
    np.testing.assert_allclose(normalised_crops(images), expected, atol=1e-6)


@pytest.mark.parametrize("size", [(240, 320), (320, 240), (47, 63), (2, 2)])
def test_scenes_of_any_size_are_predicted_as_with_torch(size, rng):
    channels = (rng.random((*size, CHANNELS), dtype=np.float32) - 0.5).astype(np.float32)
    found = GraphScenePredictor.load()(channels)
    assert found.shape == ((size[0] + 1) // 2, (size[1] + 1) // 2, SCENE_OUTPUTS)
    np.testing.assert_allclose(found, TorchScenePredictor.load()(channels), atol=3e-5)


@pytest.mark.parametrize("task", OUTPUTS)
def test_crops_are_predicted_as_with_torch(task, rng):
    crops = random_crops(5, rng)
    found = GraphCropPredictor.load(task)(*crops)
    np.testing.assert_allclose(found, TorchCropPredictor.load(task)(*crops), atol=1e-5)
    assert GraphCropPredictor.load(task)(crops[0][:0], crops[1][:0]).shape == (0, OUTPUTS[task])


@pytest.mark.parametrize("task", OUTPUTS)
def test_more_crops_than_one_pass_takes(task, rng, monkeypatch):
    crops = random_crops(5, rng)
    network = GraphCropPredictor.load(task)
    at_once = network(*crops)
    monkeypatch.setattr("perception.detection.graph_predictors._BATCH", 2)
    np.testing.assert_allclose(network(*crops), at_once, atol=1e-6)


def test_other_weights_with_their_temperature(tmp_path, rng):
    torch.manual_seed(0)
    save_crop_network(create_network("class"), tmp_path / "a.safetensors", "class", 1.7)
    crops, found = random_crops(3, rng), GraphCropPredictor.load("class", tmp_path / "a.safetensors")
    assert found.temperature == 1.7
    expected = TorchCropPredictor.load("class", tmp_path / "a.safetensors")(*crops)
    np.testing.assert_allclose(found(*crops), expected, atol=1e-5)


def test_concurrent_frames_do_not_disturb_each_other(rng):
    network = GraphScenePredictor.load()
    views = [rng.random((64, 64 + 2 * k, CHANNELS), dtype=np.float32) for k in range(6)]
    alone = [network(view) for view in views]
    with ThreadPoolExecutor(3) as pool:
        for a, b in zip(alone, pool.map(network, views), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("task", OUTPUTS)
def test_weights_of_another_network_are_refused(tmp_path, task):
    path = tmp_path / "a.safetensors"
    save_weights(CropNet(7).state_dict(), path, {"task": task})
    with pytest.raises(
        PerceptionError, match=rf"do not fit the network .*nodeslam train {TRAINED_BY[task]}`"
    ):
        GraphCropPredictor.load(task, path)
    with pytest.raises(PerceptionError, match=rf"are for '{task}', not 'scene'; .*nodeslam train detector`"):
        GraphScenePredictor.load(path)
