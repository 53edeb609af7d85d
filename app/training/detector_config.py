"""Settings of the training job of the detector, and what its parts report."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from app.training.crop_dataset import Progress
from perception.detection.crop_training import TrainingConfig

RENDERING_SHARE = 0.25  # progress of the job after rendering
STACKED = 0.5  # share of the images of the second cycle with objects on or in others


@dataclass(frozen=True)
class TrainDetectorConfig:
    """Configuration of the job; the defaults are those of the shipped weights.

    Attributes:
        pictures: Number of images of the training families, for both networks.
        further: Number of further such images, for the class network alone.
        stacked: Number of images, half of them with objects on or in others, for a second cycle of the class
            network; none without them.
        validation: Number of further images of the training families for the calibration.
        test: Number of images of the test families for the evaluation.
        training: Hyperparameters of the class network; its seed is that of all networks.
        second: Hyperparameters of its second cycle, which starts from the network of the first; all but the
            seed.
        scene_passes: Epochs of the scene network relative to those of the class network.
        tensorboard: Whether to write TensorBoard curves (extra `train`).
        device: Torch device for training.
    """

    pictures: int = 10000
    further: int = 20000
    stacked: int = 12000
    validation: int = 300
    test: int = 300
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=8))
    second: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=12, learning_rate=1e-3))
    scene_passes: float = 5 / 4
    tensorboard: bool = False
    device: str = "cpu"

    @property
    def scene_epochs(self) -> int:
        """Number of epochs of the scene network."""
        return max(1, round(self.scene_passes * self.training.epochs))


def provenance(config: TrainDetectorConfig) -> dict[str, str]:
    """Return the metadata of a weights file."""
    return {"seed": str(config.training.seed), "config": repr(config), "torch": torch.__version__}


def stage_progress(progress: Progress | None, low: float, high: float) -> Progress:
    """Return a callback that maps the progress of a stage to the share ``low`` to ``high`` of the job."""
    return lambda what, share: report(progress, what, low + (high - low) * share)


def report(progress: Progress | None, what: str, share: float) -> None:
    """Call a callback with what is done and the share that is, if there is one."""
    if progress:
        progress(what, share)
