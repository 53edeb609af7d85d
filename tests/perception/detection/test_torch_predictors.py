"""Networks of PyTorch as predictors."""

import numpy as np

from perception.detection.crop_network import CropNet, predict
from perception.detection.scene_network import SceneNet, predict_scene
from perception.detection.torch_predictors import TorchCropPredictor, TorchScenePredictor
from perception.detection.working_view import CHANNELS


def test_a_scene_network_predicts():
    network, channels = SceneNet().eval(), np.ones((32, 64, CHANNELS), np.float32)
    found = TorchScenePredictor(network)(channels)
    np.testing.assert_array_equal(found, predict_scene(network, channels))
    assert isinstance(TorchScenePredictor.load(device="cpu").network, SceneNet)


def test_a_crop_network_predicts_with_its_temperature():
    network = CropNet(5).eval()
    crops = np.full((3, 64, 64, 6), 99, np.uint8), np.zeros((3, 2), np.float32)
    found = TorchCropPredictor(network, 2.0)(*crops)
    np.testing.assert_array_equal(found, predict(network, 2.0, *crops))
    assert 0 < TorchCropPredictor.load("pose").temperature < 10
