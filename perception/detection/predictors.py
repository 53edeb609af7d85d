"""Predictions of the detection networks: interfaces, and the shipped networks on a device.

On the CPU the networks run with ONNX Runtime, whose import takes a tenth of PyTorch's; on CUDA with PyTorch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from perception.detection.tasks import Task


@runtime_checkable
class ScenePredictor(Protocol):
    """The scene network."""

    def __call__(self, channels: Float[np.ndarray, "h w 8"]) -> Float[np.ndarray, "h2 w2 12"]:
        """Return the outputs for one view (``WorkingView.channels``) at half its resolution, rounded up."""
        ...


@runtime_checkable
class CropPredictor(Protocol):
    """The network or ensemble of one task on crops."""

    def __call__(
        self, images: UInt8[np.ndarray, "n side side 6"], context: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n outputs"]:
        """Return the calibrated probabilities of crops (``crops.Crop``)."""
        ...


def load_scene_predictor(path: Path | None = None, device: str = "cpu") -> ScenePredictor:
    """Return the scene network.

    Args:
        path: Weights file; the shipped one if None.
        device: Where the network runs.

    Raises:
        PerceptionError: The file is missing, damaged, differs from its checksum, or is of another network.
    """
    if device == "cpu":
        from perception.detection.graph_predictors import GraphScenePredictor

        return GraphScenePredictor.load(path)
    from perception.detection.torch_predictors import TorchScenePredictor

    return TorchScenePredictor.load(path, device)


def load_crop_predictor(task: Task, path: Path | None = None, device: str = "cpu") -> CropPredictor:
    """Return the network of a task; further arguments and errors as in ``load_scene_predictor``."""
    if device == "cpu":
        from perception.detection.graph_predictors import GraphCropPredictor

        return GraphCropPredictor.load(task, path)
    from perception.detection.torch_predictors import TorchCropPredictor

    return TorchCropPredictor.load(task, path, device)
