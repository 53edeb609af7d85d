"""`nodeslam train detector`: render scenes of the training families, train scene and class networks, judge.

Writes weights, model card and metrics; the renders and the checkpoints stay in the folder, so that the same
command run again goes on where it stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from app.training.crop_dataset import LabelledCrops, Progress, Split
from app.training.files import checksums, summary_writer
from app.training.scene_dataset import (
    UPRIGHT,
    Pictures,
    close_up_shards,
    rendered_shards,
    shard_crops,
    shard_pictures,
)
from perception.detection.network import (
    LABELS,
    MEMBERS,
    OTHER,
    WEIGHTS_FILES,
    CropNet,
    CropNetwork,
    Task,
    predict,
    save_network,
    together,
)
from perception.detection.scene_network import WEIGHTS_FILE, SceneNet, save_scene_network
from perception.detection.scene_training import SceneTrainingConfig, train_scene_network
from perception.detection.training import (
    CropSet,
    TrainingConfig,
    calibrated_temperature,
    train_crop_network,
)

logger = logging.getLogger(__name__)
RENDERING_SHARE, SCENE_SHARE = 0.25, 0.9  # of the whole job, at the end of these stages, for the progress bar


@dataclass(frozen=True)
class TrainDetectorConfig:
    """The job behind the shipped weights; its defaults reproduce them.

    Attributes:
        pictures: rendered scenes of the training families, for the scene network.
        close_ups: further ones of which only crops are kept, for the class and yaw networks.
        upright_close_ups: further ones for the class network, mostly of bottles and cans in many shapes.
        validation: further ones of the same families, for the probabilities' calibration.
        test: such scenes of the test families, to judge by.
        training: how to train; the seed is that of both networks, the epochs are the class network's, and
            the scene network makes ``scene_passes`` of them over its own pictures.
        tensorboard: also write curves for TensorBoard (extra `train`).
        device: "cpu" or "cuda".
    """

    pictures: int = 3000
    close_ups: int = 2500
    upright_close_ups: int = 2500
    validation: int = 250
    test: int = 250
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=24))
    scene_passes: float = 0.5
    tensorboard: bool = False
    device: str = "cpu"

    @property
    def scene_epochs(self) -> int:
        return max(1, round(self.scene_passes * self.training.epochs))


@dataclass(frozen=True)
class RenderedCrops:
    """Crops by what they are for."""

    training: LabelledCrops
    validation: LabelledCrops
    test: LabelledCrops


def run(config: TrainDetectorConfig, out_dir: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Train into a folder: `scenes/`, checkpoints, `scene.safetensors`, `detector.safetensors`, card.

    Returns:
        the report's metrics: accuracy of the class network, per class too, and its confusion matrix.
    """
    folder, seed = out_dir / "scenes", config.training.seed
    pictures = rendered_shards(
        folder, "train", config.pictures, seed, part(progress, 0.0, 0.5 * RENDERING_SHARE)
    )
    crops = rendered_crops(config, folder, part(progress, 0.5 * RENDERING_SHARE, 0.75 * RENDERING_SHARE))
    upright = rendered_upright(config, folder, part(progress, 0.75 * RENDERING_SHARE, RENDERING_SHARE))
    training = LabelledCrops.joined([crops.training, upright])
    scene = trained_scene(shard_pictures(pictures), config, out_dir, progress)
    save_scene_network(scene, out_dir / WEIGHTS_FILE, provenance(config))
    sets = class_set(training), class_set(crops.validation)
    network, temperature = trained("class", *sets, config, out_dir, progress, SCENE_SHARE)
    metrics = class_metrics(crops.test, predict(network, temperature, crops.test.images, crops.test.context))
    save_network(network, out_dir / WEIGHTS_FILES["class"], "class", temperature, provenance(config))
    card = _card(config, metrics, scene, network, temperature, len(training))
    card += checksums(out_dir / WEIGHTS_FILE, out_dir / WEIGHTS_FILES["class"])
    (out_dir / "detector.md").write_text(card, "utf-8")
    return metrics


def rendered_crops(config: TrainDetectorConfig, folder: Path, progress: Progress | None) -> RenderedCrops:
    """Training, validation and test crops, rendered or from an earlier start of the same job."""
    seed = config.training.seed

    def crops(split: Split, pictures: int, seed: int, low: float, high: float) -> LabelledCrops:
        return shard_crops(close_up_shards(folder, split, pictures, seed, part(progress, low, high)))

    return RenderedCrops(
        crops("train", config.close_ups, seed, 0.0, 0.8),
        crops("train", config.validation, seed + 1, 0.8, 0.9),
        crops("test", config.test, seed, 0.9, 1.0),
    )


def rendered_upright(config: TrainDetectorConfig, folder: Path, progress: Progress | None) -> LabelledCrops:
    """Further training crops of bottles and cans, rendered or from an earlier start of the same job."""
    seed = config.training.seed
    return shard_crops(
        close_up_shards(folder, "train", config.upright_close_ups, seed, progress, kind=UPRIGHT)
    )


def part(progress: Progress | None, low: float, high: float) -> Progress:
    """Progress of one part of a job, told as that of the whole."""
    return lambda what, share: _tell(progress, what, low + (high - low) * share)


def trained_scene(
    pictures: Pictures, config: TrainDetectorConfig, out_dir: Path, progress: Progress | None
) -> SceneNet:
    """The scene network, with progress."""
    settings = SceneTrainingConfig(epochs=config.scene_epochs, seed=config.training.seed)

    def on_step(step: int, steps: int, figures: dict[str, float]) -> None:
        del figures
        share = RENDERING_SHARE + (SCENE_SHARE - RENDERING_SHARE) * step / steps
        _tell(progress, f"scenes, step {step} of {steps}", share)

    return train_scene_network(pictures.labelled, len(pictures), settings, out_dir, config.device, on_step)


def trained(
    task: Task,
    training: CropSet,
    validation: CropSet,
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
    begin: float,
) -> tuple[CropNetwork, float]:
    """What answers for a task and its temperature, with progress (from ``begin`` on) and curves.

    The members of a committee differ in their seeds; all but the first keep their checkpoints in folders
    of their own.
    """
    curves = summary_writer(out_dir) if config.tensorboard else None
    count = MEMBERS[task]

    def train(member: int) -> CropNet:
        def on_epoch(epoch: int, epochs: int, figures: dict[str, float]) -> None:
            done, total = member * epochs + epoch, count * epochs
            _tell(progress, f"epoch {done} of {total}", begin + (1 - begin) * done / total)
            if curves is not None:
                for name, value in figures.items():
                    curves.add_scalar(f"{task}/{name}", value, done)
                curves.flush()

        folder = out_dir if member == 0 else out_dir / f"member{member}"
        settings = replace(config.training, seed=config.training.seed + member)
        return train_crop_network(task, training, validation, settings, folder, config.device, on_epoch)

    network = together([train(member) for member in range(count)])
    return network, calibrated_temperature(network, validation)


def _tell(progress: Callable[[str, float], None] | None, what: str, share: float) -> None:
    if progress:
        progress(what, share)


def class_set(crops: LabelledCrops) -> CropSet:
    return CropSet(crops.images, crops.context, np.eye(len(LABELS), dtype=np.float32)[crops.label])


def class_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n 5"]) -> dict[str, Any]:
    """How well classes are told apart on crops."""
    best = probabilities.argmax(1)
    confusion = confusion_matrix(crops.label, best)
    things, others = crops.label != OTHER, crops.label == OTHER
    sure = probabilities[np.arange(len(best)), best]
    return {
        "crops": len(crops),
        "accuracy": float((best == crops.label).mean()),
        "accuracy_objects": float((best == crops.label)[things].mean()),
        "accuracy_per_class": {
            name: float(confusion[i, i] / max(confusion[i].sum(), 1)) for i, name in enumerate(LABELS)
        },
        "distractors_taken_for_objects": float((best[others] != OTHER).mean()),
        "objects_taken_for_distractors": float((best[things] == OTHER).mean()),
        "calibration_error": calibration_error(sure, best == crops.label),
        "confusion": confusion.tolist(),
    }


def confusion_matrix(true: Int[np.ndarray, "n"], found: Int[np.ndarray, "n"]) -> Int[np.ndarray, "5 5"]:
    """Counts; rows are the truth."""
    size = len(LABELS)
    return np.bincount(true * size + found, minlength=size**2).reshape(size, size)


def calibration_error(score: Float[np.ndarray, "n"], correct: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error: how far scores are from the share that is right, by bins of score."""
    index = np.minimum((score * bins).astype(int), bins - 1)
    gaps = [abs((score - correct)[index == b].sum()) for b in range(bins)]
    return float(sum(gaps) / len(score))


def provenance(config: TrainDetectorConfig) -> dict[str, str]:
    """Metadata of a weights file."""
    return {"seed": str(config.training.seed), "config": repr(config), "torch": torch.__version__}


def _card(
    config: TrainDetectorConfig,
    metrics: dict[str, Any],
    scene: SceneNet,
    network: CropNetwork,
    temperature: float,
    crops: int,
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    header = "| true \\ predicted | " + " | ".join(LABELS) + " | right |\n|" + " --- |" * (len(LABELS) + 2)
    rows = "\n".join(
        f"| {name} | " + " | ".join(str(n) for n in row) + f" | {metrics['accuracy_per_class'][name]:.3f} |"
        for name, row in zip(LABELS, metrics["confusion"])
    )
    return _CARD.format(
        scene_parameters=sum(p.numel() for p in scene.parameters()),
        parameters=sum(p.numel() for p in network.parameters()), temperature=temperature, crops=crops,
        members=MEMBERS["class"], config=config, training=config.training, scene_epochs=config.scene_epochs,
        torch=torch.__version__.split("+")[0], confusion=f"{header}\n{rows}", m=metrics,
    )  # fmt: skip


_CARD = """# Detector: instance network and class network

**Instance network** (`scene.safetensors`): predicts for every pixel of a 320-pixel view (colour, height
above the support plane, and scale) whether it belongs to an object, of which class, and the position of its
object's footprint in the plane; instances are the clusters of these votes
(`perception/detection/instances.py`). {scene_parameters} parameters, float16.

**Class network** (`detector.safetensors`): classifies a gravity-upright crop of 64 x 64 pixels around one
instance (colour, mask, height, relative depth, and the surroundings, `perception/detection/crops.py`, with
the crop's size and elevation) as mug, bowl, bottle, can or other. An ensemble of {members} networks with
different seeds, {parameters} parameters in total, float32. Logits are averaged over the ensemble and over
the crop and its mirror image, and divided by the temperature {temperature:.2f}, which was fitted on further
scenes of the training families. The detector averages the log-probabilities of instance and class networks;
masks from other sources are classified by the class network alone.

**Training**: `nodeslam train detector --seed {training.seed}` with torch {torch}: {scene_epochs} epochs of
the instance network with batch size 8, {training.epochs} of each class network with batch size
{training.batch}, AdamW with learning rate {training.learning_rate} and cosine decay, float32, on a CPU.

**Data**: for the instance network {config.pictures} scenes with objects of the training families and
distractors, rendered at 640 x 480 by MuJoCo's classic renderer (`sim_assets/datasets/training_scenes.py`:
random textures, prints, gloss, lights, camera height, tilt and roll, gaps down to contact; depth without
noise, with 2 mm of noise, and with RealSense-like errors), augmented by mirroring, colour changes and
further depth holes. For the class network {crops} crops: from {config.close_ups} denser scenes with more
mugs, bottles, cans and distractors, and from {config.upright_close_ups} scenes with mostly bottles and
cans, with a new set of shapes every 28 scenes (three in five of the flat and lidded cans stand on a
narrower foot). Their true masks are made ragged, truncated, incomplete, or extended by a part of a
neighbour; crops are mirrored, warped, shifted, truncated and recoloured. No photographs.

**Evaluation of the class network** on {m[crops]} such masks in {config.test} classic scenes of the test
families, single views: accuracy {m[accuracy]:.3f}, of objects alone {m[accuracy_objects]:.3f}; distractors
classified as objects {m[distractors_taken_for_objects]:.3f}, objects classified as other
{m[objects_taken_for_distractors]:.3f}; expected calibration error {m[calibration_error]:.3f}.

{confusion}

`nodeslam evaluate detection` evaluates the whole detector.

**Limitations**: upright objects on a plane. Most errors occur with strong occlusion and with parts
truncated by the image border. Lying or stacked objects, clear glass and real images are not in the training
data.
"""
