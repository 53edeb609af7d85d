"""`nodeslam train detector`: render scenes of the training families, train the class network, judge it.

Writes weights, model card and metrics; the renders and the checkpoint stay in the folder, so that the same
command run again goes on where it stopped.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int

from app.training.labels import LabelledCrops, Progress, cached_crops
from perception.detection.network import LABELS, OTHER, WEIGHTS_FILES, CropNet, Task, predict, save_network
from perception.detection.training import CropSet, TrainingConfig, train_crop_network
from perception.errors import PerceptionError

logger = logging.getLogger(__name__)
RENDERING_SHARE = 0.5  # of the whole job, for the progress bar


@dataclass(frozen=True)
class TrainDetectorConfig:
    """The job behind the shipped weights; its defaults reproduce them.

    Attributes:
        pictures: rendered scenes of the training families.
        validation: further ones of the same families, for the probabilities' calibration.
        test: rendered scenes of the test families, to judge by.
        width: of the pictures in pixels; they are 4:3.
        training: how to train.
        tensorboard: also write curves for TensorBoard (extra `train`).
        device: "cpu" or "cuda".
    """

    pictures: int = 6000
    validation: int = 250
    test: int = 500
    width: int = 320
    training: TrainingConfig = field(default_factory=TrainingConfig)
    tensorboard: bool = False
    device: str = "cpu"


def run(config: TrainDetectorConfig, out_dir: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Train into a folder: crops, checkpoint, `detector.safetensors`, `detector.md`.

    Returns:
        the report's metrics: accuracy, accuracy per class, confusion matrix, mask recall and IoU.
    """
    training, validation, test = rendered(config, out_dir, progress)
    network, temperature = trained(
        "class", class_set(training), class_set(validation), config, out_dir, progress
    )
    metrics = class_metrics(test, predict(network, temperature, test.images, test.context))
    save_network(network, out_dir / WEIGHTS_FILES["class"], "class", temperature, provenance(config))
    (out_dir / "detector.md").write_text(_card(config, metrics, network, temperature, len(training)), "utf-8")
    return metrics


def rendered(
    config: TrainDetectorConfig, out_dir: Path, progress: Progress | None
) -> tuple[LabelledCrops, LabelledCrops, LabelledCrops]:
    """Training, validation and test crops, rendered or from an earlier start of the same job."""
    seed, folder = config.training.seed, out_dir / "crops"

    def part(low: float, high: float) -> Progress:
        return lambda what, share: _tell(progress, what, RENDERING_SHARE * (low + (high - low) * share))

    return (
        cached_crops(folder, "train", config.pictures, seed, config.width, part(0.0, 0.8)),
        cached_crops(folder, "train", config.validation, seed + 1, config.width, part(0.8, 0.85)),
        cached_crops(folder, "test", config.test, seed, config.width, part(0.85, 1.0)),
    )


def trained(
    task: Task,
    training: CropSet,
    validation: CropSet,
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
) -> tuple[CropNet, float]:
    """The network for a task and its temperature, with progress and curves."""
    curves = summary_writer(out_dir) if config.tensorboard else None

    def on_epoch(epoch: int, epochs: int, figures: dict[str, float]) -> None:
        _tell(
            progress, f"epoch {epoch} of {epochs}", RENDERING_SHARE + (1 - RENDERING_SHARE) * epoch / epochs
        )
        if curves is not None:
            for name, value in figures.items():
                curves.add_scalar(f"{task}/{name}", value, epoch)
            curves.flush()

    return train_crop_network(task, training, validation, config.training, out_dir, config.device, on_epoch)


def _tell(progress: Callable[[str, float], None] | None, what: str, share: float) -> None:
    if progress:
        progress(what, share)


def class_set(crops: LabelledCrops) -> CropSet:
    return CropSet(crops.images, crops.context, np.eye(len(LABELS), dtype=np.float32)[crops.label])


def class_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n 5"]) -> dict[str, Any]:
    """How well classes are told apart on crops, and how well geometry found the masks they come from."""
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
        "mask_recall": crops.counts.recall,
        "mask_iou": crops.counts.mean_iou,
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


def summary_writer(out_dir: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise PerceptionError(
            "TensorBoard is not installed; run `pip install 'nodeslam[train]'`, or leave out --tensorboard"
        ) from error
    return SummaryWriter(str(out_dir))


def _card(
    config: TrainDetectorConfig, metrics: dict[str, Any], network: CropNet, temperature: float, crops: int
) -> str:
    """Markdown that says what the weights are, where they come from and how good they are."""
    header = "| true \\ found | " + " | ".join(LABELS) + " | right |\n|" + " --- |" * (len(LABELS) + 2)
    rows = "\n".join(
        f"| {name} | " + " | ".join(str(n) for n in row) + f" | {metrics['accuracy_per_class'][name]:.3f} |"
        for name, row in zip(LABELS, metrics["confusion"])
    )
    return _CARD.format(
        parameters=sum(p.numel() for p in network.parameters()), temperature=temperature, crops=crops,
        config=config, training=config.training, torch=torch.__version__.split("+")[0],
        confusion=f"{header}\n{rows}", m=metrics,
    )  # fmt: skip


_CARD = """# Class network

Says whether an instance is a mug, a bowl, a bottle, a can or nothing of these, from a gravity-upright 64 x 64
crop: masked colour, mask, height above the support plane, relative depth (`perception/detection/crops.py`),
and the crop's size and elevation. {parameters} weights, float32 safetensors. Logits are divided by
{temperature:.2f}, found on further renders of the training families, so that scores are probabilities.

**Made by** `nodeslam train detector --seed {training.seed}` with torch {torch}: {training.epochs} epochs of
AdamW {training.learning_rate}, cosine schedule, batch {training.batch}, float32, CPU.

**Data**: {config.pictures} rendered scenes of the training families and of distractors, {config.width} pixels
wide (`sim_assets/training_scenes.py`: random textures, light, camera, gaps, depth noise of all kinds), cut
into {crops} crops by the detector's own segmentation. Mirrored, shifted, recoloured, partly cut off, and
noisier still in training. MuJoCo's classic renderer only; no photographs.

**Judged on** {config.test} scenes of the test families, {m[crops]} crops, single views, no voting: accuracy
{m[accuracy]:.3f} over all, {m[accuracy_objects]:.3f} over objects; distractors taken for objects
{m[distractors_taken_for_objects]:.3f}, objects for distractors {m[objects_taken_for_distractors]:.3f};
expected calibration error {m[calibration_error]:.3f}. Segmentation on the same scenes (gaps from 8 mm, all
noises): recall {m[mask_recall]:.3f} at IoU 0.5, mean IoU of the found {m[mask_iou]:.3f}.

{confusion}

**Limits**: upright objects on a plane; parts cut by the image border and heavy occlusion are where it errs.
Lying objects, stacks and real images were not trained on.
"""
