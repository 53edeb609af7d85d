"""Metrics of class probabilities whose values are known."""

import numpy as np
import pytest

from app.training.class_metrics import calibration_error, class_metrics, confusion_matrix, confusion_table
from app.training.crop_dataset import LabelledCrops


def test_class_metrics_of_known_probabilities():
    n = 20
    images, zeros = np.zeros((n, 64, 64, 6), np.uint8), np.zeros(n, np.float32)
    crops = LabelledCrops(images, np.zeros((n, 2), np.float32), np.arange(n) % 5, zeros, zeros)
    probabilities = np.full((20, 5), 0.05)
    probabilities[np.arange(20), crops.label] = 0.8
    probabilities[4] = (0.8, 0.05, 0.05, 0.05, 0.05)  # a distractor classified as a mug
    metrics = class_metrics(crops, probabilities)
    assert metrics["accuracy"] == 0.95 and metrics["accuracy_objects"] == 1.0
    assert metrics["distractors_taken_for_objects"] == 0.25
    assert metrics["confusion"][4] == [1, 0, 0, 0, 3]
    assert metrics["calibration_error"] == pytest.approx(0.15)


def test_calibration_error_is_the_mean_gap_over_bins():
    score, correct = np.array([0.95, 0.95, 0.55, 0.55]), np.array([True, True, True, False])
    assert calibration_error(score, correct) == pytest.approx((2 * 0.05 + 0.1) / 4)


def test_rows_of_the_confusion_matrix_are_true_classes():
    matrix = confusion_matrix(np.array([0, 0, 4]), np.array([1, 0, 3]))
    assert matrix[0, 1] == matrix[0, 0] == matrix[4, 3] == 1 and matrix.sum() == 3


def test_the_table_has_true_labels_as_rows_and_their_shares_last():
    table = confusion_table(("can", "mug"), [[7, 3], [1, 4]], {"can": 0.7, "mug": 0.8})
    assert table.splitlines() == [
        "| true \\ predicted | can | mug | right |",
        "| --- | --- | --- | --- |",
        "| can | 7 | 3 | 0.700 |",
        "| mug | 1 | 4 | 0.800 |",
    ]
