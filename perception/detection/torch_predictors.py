"""The detection networks with PyTorch, for CUDA and for networks in training."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from perception.detection.crop_network import CropNetwork, load_crop_network, predict
from perception.detection.scene_network import SceneNet, load_scene_network, predict_scene
from perception.detection.tasks import Task


@dataclass(frozen=True)
class TorchScenePredictor:
    """The scene network.

    Attributes:
        network: The network in evaluation mode.
    """

    network: SceneNet

    @staticmethod
    def load(path: Path | None = None, device: str = "cpu") -> TorchScenePredictor:
        """Load the shipped weights, or those of a file; raises as ``load_scene_predictor``."""
        return TorchScenePredictor(load_scene_network(path, device))

    def __call__(self, channels: Float[np.ndarray, "h w 8"]) -> Float[np.ndarray, "h2 w2 12"]:
        """Return the outputs for one view at half its resolution."""
        return predict_scene(self.network, channels)


@dataclass(frozen=True)
class TorchCropPredictor:
    """The network or ensemble of one task on crops.

    Attributes:
        network: The network in evaluation mode.
        temperature: Divisor of the logits that calibrates the probabilities.
    """

    network: CropNetwork
    temperature: float

    @staticmethod
    def load(task: Task, path: Path | None = None, device: str = "cpu") -> TorchCropPredictor:
        """Load the shipped weights, or those of a file; raises as ``load_scene_predictor``."""
        return TorchCropPredictor(*load_crop_network(task, path, device))

    def __call__(
        self, images: UInt8[np.ndarray, "n side side 6"], context: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "n outputs"]:
        """Return the calibrated probabilities of crops."""
        return predict(self.network, self.temperature, images, context)
