"""The scene network: weights files, half precision, odd sizes."""

import numpy as np
import pytest
import torch

from perception.detection.scene_network import (
    SceneNet,
    load_scene_network,
    predict_scene,
    save_scene_network,
)
from perception.detection.tasks import SCENE_OUTPUTS
from perception.detection.working_view import CHANNELS
from perception.errors import PerceptionError


def test_round_trip_of_weights_in_half_precision(tmp_path):
    torch.manual_seed(0)
    network = SceneNet().eval()
    save_scene_network(network, tmp_path / "scene.safetensors", {"seed": "0"})
    loaded = load_scene_network(tmp_path / "scene.safetensors")
    channels = np.random.default_rng(0).standard_normal((47, 63, CHANNELS)).astype(np.float32)
    mine, theirs = predict_scene(network, channels), predict_scene(loaded, channels)
    assert mine.shape == (24, 32, SCENE_OUTPUTS)
    np.testing.assert_allclose(mine, theirs, atol=0.02)  # half precision
    with pytest.raises(PerceptionError, match="are missing"):
        load_scene_network(tmp_path / "elsewhere.safetensors")
    (tmp_path / "scene.safetensors").write_bytes(b"not weights")
    with pytest.raises(PerceptionError, match="cannot be read"):
        load_scene_network(tmp_path / "scene.safetensors")


def test_folding_the_normalisation_keeps_the_outputs(tmp_path):
    torch.manual_seed(0)
    network = SceneNet()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.running_mean, -0.5, 0.5)
    save_scene_network(network, tmp_path / "scene.safetensors")
    folded = load_scene_network(tmp_path / "scene.safetensors")
    assert not any(isinstance(m, torch.nn.BatchNorm2d) for m in folded.modules())
    plain = SceneNet().eval()
    plain.load_state_dict(
        {k: v.half().float() if v.is_floating_point() else v for k, v in network.state_dict().items()}
    )
    channels = np.random.default_rng(0).standard_normal((32, 64, CHANNELS)).astype(np.float32)
    np.testing.assert_allclose(predict_scene(folded, channels), predict_scene(plain, channels), atol=1e-3)
