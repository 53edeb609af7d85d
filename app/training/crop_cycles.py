"""Training of crop networks: one cycle or two, of one network or an ensemble, and their calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from app.training.crop_dataset import LabelledCrops, Progress
from app.training.detector_config import TrainDetectorConfig, provenance, report, stage_progress
from app.training.files import summary_writer
from app.training.fitting import fit_crop_network
from perception.detection.crop_network import (
    CropNet,
    CropNetwork,
    ensemble_of,
    members_of,
    predict,
    save_crop_network,
)
from perception.detection.crop_training import (
    CropSet,
    TrainingData,
    TrainingJob,
    calibrated_temperature,
    equalise_priors,
)
from perception.detection.tasks import ENSEMBLE_SIZE, Task


@dataclass(frozen=True)
class CalibratedNetwork:
    """A trained crop network or ensemble, and the temperature that its logits are divided by."""

    network: CropNetwork
    temperature: float

    def probabilities(self, crops: LabelledCrops) -> Float[np.ndarray, "n c"]:
        """Return the calibrated probabilities of crops."""
        return predict(self.network, self.temperature, crops.images, crops.context)

    def save(self, path: Path, task: Task, config: TrainDetectorConfig) -> None:
        """Write network and temperature with their provenance."""
        save_crop_network(self.network, path, task, self.temperature, provenance(config))


@dataclass(frozen=True)
class CropSplits:
    """Labelled crops of each purpose; all but those of the tests are of the training families.

    Attributes:
        training: Crops of the first cycle.
        validation: Crops for the calibration.
        test: Crops of scenes as those of the first cycle.
        second, second_test: Crops of the second cycle, and of scenes as its own; None without one.
    """

    training: LabelledCrops
    validation: LabelledCrops
    test: LabelledCrops
    second: LabelledCrops | None = None
    second_test: LabelledCrops | None = None


def train_cycles(
    task: Task,
    crops: CropSplits,
    targets: Callable[[LabelledCrops], CropSet],
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
    processes: int = 1,
) -> CalibratedNetwork:
    """Train a network in one cycle, or in a second one on other crops too.

    The second cycle has its checkpoint in the subfolder `second`.
    """
    validation = targets(crops.validation)
    data = TrainingData(targets(crops.training), validation)
    if crops.second is None:
        return train_ensemble(task, data, config, out_dir, progress, processes)
    samples = [len(crops.training) * config.training.epochs, len(crops.second) * config.second.epochs]
    share = samples[0] / sum(samples)
    first = train_ensemble(task, data, config, out_dir, stage_progress(progress, 0.0, share), processes)
    data = TrainingData(targets(crops.second), validation)
    settings = replace(config, training=replace(config.second, seed=config.training.seed))
    part = stage_progress(progress, share, 1.0)
    return train_ensemble(task, data, settings, out_dir / "second", part, processes, first.network)


def train_ensemble(
    task: Task,
    data: TrainingData,
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
    processes: int = 1,
    start: CropNetwork | None = None,
) -> CalibratedNetwork:
    """Train and calibrate the network or ensemble of a task.

    The members of an ensemble differ in their seeds. The first has its checkpoint in ``out_dir``, the others
    in subfolders. Networks of classes do not depend on the classes' shares in the training data.
    ``start`` is a network or ensemble to go on from.
    """
    starts = [None] * ENSEMBLE_SIZE[task] if start is None else members_of(start)
    curves = summary_writer(out_dir) if config.tensorboard else None
    count = ENSEMBLE_SIZE[task]

    def train(member: int) -> CropNet:
        def on_epoch(epoch: int, epochs: int, metrics: dict[str, float]) -> None:
            done, total = member * epochs + epoch, count * epochs
            report(progress, f"epoch {done} of {total}", done / total)
            if curves is not None:
                for name, value in metrics.items():
                    curves.add_scalar(f"{task}/{name}", value, done)
                curves.flush()

        folder = out_dir if member == 0 else out_dir / f"member{member}"
        settings = replace(config.training, seed=config.training.seed + member)
        job = TrainingJob(folder, config.device, on_epoch, start=starts[member])
        return fit_crop_network(task, data, settings, job, processes)

    network = ensemble_of([train(member) for member in range(count)])
    if task == "class":
        equalise_priors(network, data.training.targets)
    return CalibratedNetwork(network, calibrated_temperature(network, data.validation))
