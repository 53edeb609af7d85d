"""The model card has the figures of its training, and mentions stacks only where there were any."""

import numpy as np

from app.training.crop_cycles import CalibratedNetwork, CropSplits
from app.training.crop_dataset import LabelledCrops
from app.training.detector_card import model_card
from app.training.detector_config import TrainDetectorConfig
from perception.detection.crop_network import create_network
from perception.detection.scene_network import SceneNet
from perception.detection.tasks import LABELS


def crops(n):
    zeros = np.zeros(n, np.float32)
    images = np.zeros((n, 64, 64, 6), np.uint8)
    return LabelledCrops(images, np.zeros((n, 2), np.float32), np.zeros(n, int), zeros, zeros)


def card(stacked=None):
    confusion = 10 * np.eye(len(LABELS), dtype=int) + 1
    metrics = {
        "confusion": confusion.tolist(), "accuracy_per_class": {name: 0.877 for name in LABELS},
        "crops": 75, "accuracy": 0.9123, "accuracy_objects": 0.9234, "accuracy_with_stacks": 0.8321,
        "distractors_taken_for_objects": 0.0346, "objects_taken_for_distractors": 0.0456,
        "calibration_error": 0.0123,
    }  # fmt: skip
    trained = CalibratedNetwork(create_network("class").eval(), 1.234)
    splits = CropSplits(crops(41), crops(1), crops(1), stacked)
    return model_card(TrainDetectorConfig(), metrics, SceneNet(), trained, splits).replace("\n", " ")


def test_the_card_has_the_figures_of_the_training():
    text = card()
    for figure in ("1.23", "41 crops", "accuracy 0.912;", "objects alone 0.923", "0.035", "0.046", "0.012"):
        assert figure in text, figure
    assert "| mug | 11 | 1 | 1 | 1 | 1 | 0.877 |" in text
    assert "second cycle" not in text and "0.832" not in text


def test_the_card_says_how_stacks_were_learned():
    text = card(crops(23))
    assert "second cycle of 12 epochs" in text and "23 crops of 12000 other images, 50%" in text
    assert "0.832 on as many scenes with stacks" in text
