"""ONNX Runtime on the CPU, PyTorch elsewhere."""

import subprocess
import sys

import pytest

from perception.detection.crop_network import create_network
from perception.detection.graph_predictors import GraphCropPredictor, GraphScenePredictor
from perception.detection.predictors import load_crop_predictor, load_scene_predictor
from perception.detection.scene_network import SceneNet
from perception.detection.tasks import OUTPUTS
from perception.detection.torch_predictors import TorchCropPredictor, TorchScenePredictor


def test_networks_on_the_cpu_are_graphs():
    assert isinstance(load_scene_predictor(), GraphScenePredictor)
    assert all(isinstance(load_crop_predictor(task), GraphCropPredictor) for task in OUTPUTS)


def test_networks_on_other_devices_run_with_torch(monkeypatch):
    requested = []
    loaded = {
        TorchScenePredictor: TorchScenePredictor(SceneNet()),
        TorchCropPredictor: TorchCropPredictor(create_network("yaw"), 1.0),
    }
    for kind, network in loaded.items():
        monkeypatch.setattr(kind, "load", lambda *args, network=network: requested.append(args) or network)
    assert isinstance(load_scene_predictor(device="cuda"), TorchScenePredictor)
    assert isinstance(load_crop_predictor("yaw", device="cuda"), TorchCropPredictor)
    assert requested == [(None, "cuda"), ("yaw", None, "cuda")]


@pytest.mark.parametrize("call", ["load_scene_predictor()", "load_crop_predictor('class')"])
def test_torch_is_not_loaded_on_the_cpu(call):
    code = f"import sys; from perception.detection.predictors import *\n{call}\n"
    code += "assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
