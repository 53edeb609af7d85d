"""Fit the detection networks in this process, or in several that share every batch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from app.training.mapped import Mapped, folder_of_arrays
from app.training.processes import Report, run_on_ranks
from app.training.scene_dataset import LabelledScenes
from perception.detection.crop_network import CropNet
from perception.detection.crop_training import (
    CropSet,
    TrainingConfig,
    TrainingData,
    TrainingJob,
    train_crop_network,
)
from perception.detection.scene_network import SceneNet
from perception.detection.scene_training import SceneTrainingConfig, train_scene_network
from perception.detection.tasks import Task
from perception.distributed import Ranks


def fit_crop_network(
    task: Task, data: TrainingData, config: TrainingConfig, job: TrainingJob, processes: int = 1
) -> CropNet:
    """Train a crop network as ``train_crop_network`` does; several processes end with the last checkpoint."""
    if processes > 1:
        with folder_of_arrays(job.directory) as folder:
            training = Mapped.write(data.training, folder / "training")
            validation = Mapped.write(data.validation, folder / "validation")
            work = _CropWork(task, training, validation, config, job.directory, str(job.device), job.start)
            run_on_ranks(_fit_crops, work, processes, str(job.device), job.progress)
    return train_crop_network(task, data, config, job)


def fit_scene_network(
    scenes: LabelledScenes, config: SceneTrainingConfig, job: TrainingJob, processes: int = 1
) -> SceneNet:
    """Train the scene network as ``train_scene_network`` does; several processes end with the checkpoint."""
    if processes > 1:
        with folder_of_arrays(job.directory) as folder:
            mapped = Mapped.write(scenes, folder / "scenes")
            work = _SceneWork(mapped, config, job.directory, str(job.device))
            run_on_ranks(_fit_scenes, work, processes, str(job.device), job.progress)
    return train_scene_network(scenes.labelled, len(scenes), config, job)


@dataclass(frozen=True)
class _CropWork:
    """Arguments of ``train_crop_network`` for other processes."""

    task: Task
    training: Mapped[CropSet]
    validation: Mapped[CropSet]
    config: TrainingConfig
    directory: Path
    device: str
    start: CropNet | None


def _fit_crops(work: _CropWork, ranks: Ranks, report: Report) -> None:
    data = TrainingData(work.training.open(), work.validation.open())
    job = TrainingJob(work.directory, work.device, report, ranks, work.start)
    train_crop_network(work.task, data, work.config, job)


@dataclass(frozen=True)
class _SceneWork:
    """Arguments of ``train_scene_network`` for other processes."""

    scenes: Mapped[LabelledScenes]
    config: SceneTrainingConfig
    directory: Path
    device: str


def _fit_scenes(work: _SceneWork, ranks: Ranks, report: Report) -> None:
    scenes = work.scenes.open()
    job = TrainingJob(work.directory, work.device, report, ranks)
    train_scene_network(scenes.labelled, len(scenes), work.config, job)
