"""`nodeslam train detector`: render the training families, train the scene and class networks, evaluate them.

Writes weights, model card and metrics. Rendered data and checkpoints stay in the folder, so that the same
command resumes an interrupted run.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.jobs import Workers
from app.training.class_metrics import class_metrics
from app.training.crop_cycles import CropSplits, train_cycles
from app.training.crop_dataset import LabelledCrops, Progress, Split
from app.training.detector_card import model_card
from app.training.detector_config import (
    RENDERING_SHARE,
    STACKED,
    TrainDetectorConfig,
    provenance,
    report,
    stage_progress,
)
from app.training.files import checksums
from app.training.fitting import fit_scene_network
from app.training.resources import Resources
from app.training.scene_dataset import (
    LabelledScenes,
    Shard,
    load_crops,
    load_scenes,
    render_shards,
)
from perception.detection.crop_training import CropSet, TrainingJob
from perception.detection.scene_network import SceneNet, save_scene_network
from perception.detection.scene_training import SceneTrainingConfig
from perception.detection.tasks import LABELS, SCENE_WEIGHTS_FILE, WEIGHTS_FILES

SCENE_SHARE = 0.9  # progress of the job after the scene network


@dataclass(frozen=True)
class DataSets:
    """Rendered shards of each purpose; all but those of the tests are of the training families."""

    training: list[Shard]
    further: list[Shard]
    validation: list[Shard]
    test: list[Shard]
    stacked: list[Shard]
    stacked_test: list[Shard]

    def crops(self) -> CropSplits:
        """Return the crops of all shards."""
        parts = (self.training + self.further, self.validation, self.test, self.stacked, self.stacked_test)
        return CropSplits(*(load_crops([shard.crops for shard in part]) for part in parts if part))


def run(
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Render the data set, train both networks and evaluate the class network.

    Writes `scenes/`, checkpoints, `scene.safetensors`, `detector.safetensors` and `detector.md` to the
    folder.

    Returns:
        Metrics of the class network on crops of the test families (``class_metrics``).
    """
    data_sets, processes = render_data_sets(config, out_dir, progress, resources.workers), resources.processes
    scenes = load_scenes([s.scenes for s in data_sets.training])
    scene = train_scene(scenes, config, out_dir, progress, processes)
    save_scene_network(scene, out_dir / SCENE_WEIGHTS_FILE, provenance(config))
    crops = data_sets.crops()
    part = stage_progress(progress, SCENE_SHARE, 1.0)
    trained = train_cycles("class", crops, class_targets, config, out_dir, part, processes)
    metrics = class_metrics(crops.test, trained.probabilities(crops.test))
    if crops.second_test is not None:
        stacked = class_metrics(crops.second_test, trained.probabilities(crops.second_test))
        metrics |= {"accuracy_with_stacks": stacked["accuracy"]}
    trained.save(out_dir / WEIGHTS_FILES["class"], "class", config)
    card = model_card(config, metrics, scene, trained, crops)
    card += checksums(out_dir / SCENE_WEIGHTS_FILE, out_dir / WEIGHTS_FILES["class"])
    (out_dir / "detector.md").write_text(card, "utf-8")
    return metrics


def render_data_sets(
    config: TrainDetectorConfig, out_dir: Path, progress: Progress | None, workers: Workers = Workers()
) -> DataSets:
    """Render the data sets, or find those already in the folder."""
    folder, seed = out_dir / "scenes", config.training.seed
    tested, done = config.test if config.stacked else 0, 0
    total = config.pictures + config.further + config.validation + config.test + config.stacked + tested

    def shards(split: Split, pictures: int, seed: int, **options: Any) -> list[Shard]:
        nonlocal done
        low, done = done, done + pictures
        part = stage_progress(progress, *(RENDERING_SHARE * count / total for count in (low, done)))
        return render_shards(folder, split, pictures, seed, workers, part, **options) if pictures else []

    return DataSets(  # other seeds: the shapes of validation are not those of training
        shards("train", config.pictures, seed),
        shards("train", config.further, seed + 2, crops_only=True),
        shards("train", config.validation, seed + 1),
        shards("test", config.test, seed),
        shards("train", config.stacked, seed + 3, crops_only=True, stacked=STACKED),
        shards("test", tested, seed + 3, crops_only=True, stacked=STACKED),
    )


def train_scene(
    scenes: LabelledScenes,
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
    processes: int = 1,
) -> SceneNet:
    """Train the scene network, reporting progress."""
    settings = SceneTrainingConfig(epochs=config.scene_epochs, seed=config.training.seed)

    def on_step(step: int, steps: int, metrics: dict[str, float]) -> None:
        del metrics
        share = RENDERING_SHARE + (SCENE_SHARE - RENDERING_SHARE) * step / steps
        report(progress, f"scenes, step {step} of {steps}", share)

    return fit_scene_network(scenes, settings, TrainingJob(out_dir, config.device, on_step), processes)


def class_targets(crops: LabelledCrops) -> CropSet:
    """Return the crops with one-hot class targets."""
    return CropSet(crops.images, crops.context, np.eye(len(LABELS), dtype=np.float32)[crops.label])
