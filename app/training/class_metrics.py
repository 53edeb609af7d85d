"""Metrics of class probabilities: accuracies, confusion matrix, calibration error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from app.training.crop_dataset import LabelledCrops
from perception.detection.tasks import LABELS
from perception.types import OTHER


def class_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n 5"]) -> dict[str, Any]:
    """Return accuracies, confusion matrix and calibration error of class probabilities on crops."""
    best = probabilities.argmax(1)
    confusion = confusion_matrix(crops.label, best)
    objects, distractors = crops.label != OTHER, crops.label == OTHER
    confidence = probabilities[np.arange(len(best)), best]
    return {
        "crops": len(crops),
        "accuracy": float((best == crops.label).mean()),
        "accuracy_objects": float((best == crops.label)[objects].mean()),
        "accuracy_per_class": {
            name: float(confusion[i, i] / max(confusion[i].sum(), 1)) for i, name in enumerate(LABELS)
        },
        "distractors_taken_for_objects": float((best[distractors] != OTHER).mean()),
        "objects_taken_for_distractors": float((best[objects] == OTHER).mean()),
        "calibration_error": calibration_error(confidence, best == crops.label),
        "confusion": confusion.tolist(),
    }


def confusion_matrix(true: Int[np.ndarray, "n"], predicted: Int[np.ndarray, "n"]) -> Int[np.ndarray, "5 5"]:
    """Return the counts of (true class, predicted class); rows are true classes."""
    size = len(LABELS)
    return np.bincount(true * size + predicted, minlength=size**2).reshape(size, size)


def confusion_table(
    labels: Sequence[str], confusion: Sequence[Sequence[int]], right: Mapping[str, float]
) -> str:
    """Return a confusion matrix as a Markdown table, with the share of each true label that is right.

    Args:
        labels: Names of rows and columns.
        confusion: Counts of (true label, predicted label); rows are true labels.
        right: The shares in 0..1, by label.
    """
    header = "| true \\ predicted | " + " | ".join(labels) + " | right |\n|" + " --- |" * (len(labels) + 2)
    rows = (
        f"| {name} | " + " | ".join(str(n) for n in row) + f" | {right[name]:.3f} |"
        for name, row in zip(labels, confusion, strict=True)
    )
    return "\n".join((header, *rows))


def calibration_error(score: Float[np.ndarray, "n"], correct: np.ndarray, bins: int = 10) -> float:
    """Return the expected calibration error: mean gap of confidence and accuracy over equal bins of score."""
    index = np.minimum((score * bins).astype(int), bins - 1)
    gaps = [abs((score - correct)[index == b].sum()) for b in range(bins)]
    return float(sum(gaps) / len(score))
