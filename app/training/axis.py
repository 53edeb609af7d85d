"""`nodeslam train axis`: train and evaluate the network for the direction in which objects lie.

The scenes are those of `nodeslam train pose`, with nothing upright, and half of the objects bottles.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from app.training.crop_cycles import CalibratedNetwork, train_ensemble
from app.training.crop_dataset import LabelledCrops, Progress
from app.training.detector_config import RENDERING_SHARE, provenance, stage_progress
from app.training.files import checksums
from app.training.pose import PoseMix, TrainPoseConfig, posed_crops
from app.training.resources import Resources
from perception.detection.axis import along, log_odds
from perception.detection.crop_training import CropSet, TrainingConfig, TrainingData
from perception.detection.tasks import WEIGHTS_FILES
from perception.detection.yaw import soft_labels
from perception.types import POSED_CLASSES

LYING = tuple(index for index, (_, resting) in enumerate(POSED_CLASSES) if resting == "lying")
MIX = PoseMix(posed=1.0, shares=(2, 1, 7, 4), folder="axis_scenes")
SPREAD = np.radians(10.0)  # standard deviation of the labels


@dataclass(frozen=True)
class TrainAxisConfig(TrainPoseConfig):
    """Configuration of the job; more epochs than for the pose, since only what lies is trained on."""

    stacked: int = 0
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=24))


def run(
    config: TrainAxisConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Render the data set, train the axis network and evaluate it on the test families.

    Writes `axis_scenes/`, checkpoint, `axis.safetensors` and `axis.md` to the folder.

    Returns:
        Metrics of the axis network (``axis_metrics``).
    """
    crops = posed_crops(config, out_dir, progress, resources.workers, MIX)
    training, validation, test = (select_lying(c) for c in (crops.training, crops.validation, crops.test))
    data = TrainingData(axis_targets(training), axis_targets(validation))
    part = stage_progress(progress, RENDERING_SHARE, 1.0)
    trained = train_ensemble("axis", data, config, out_dir, part, resources.processes)
    metrics = axis_metrics(test, trained.probabilities(test))
    trained.save(out_dir / WEIGHTS_FILES["axis"], "axis", config)
    card = _card(config, metrics, trained, len(training))
    (out_dir / "axis.md").write_text(card + checksums(out_dir / WEIGHTS_FILES["axis"]), "utf-8")
    return metrics


def select_lying(crops: LabelledCrops) -> LabelledCrops:
    """Return the crops of what lies."""
    return crops.subset(np.isin(crops.label, LYING))


def axis_targets(crops: LabelledCrops) -> CropSet:
    """Return the crops with soft bins of the axis's direction as targets."""
    targets = soft_labels(crops.yaw.astype(np.float64), spread=SPREAD)
    return CropSet(crops.images, crops.context, targets)


def axis_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n b"]) -> dict[str, Any]:
    """Return by class how often the right one of the two directions along the true axis is the likelier."""
    odds = np.array([log_odds(p, along(yaw)) for p, yaw in zip(probabilities, crops.yaw.tolist())])
    metrics: dict[str, Any] = {"crops": len(crops)}
    for index in LYING:
        metrics[POSED_CLASSES[index][0]] = _figures(odds, crops.label == index)
    metrics["all"] = _figures(odds, np.ones(len(crops), bool))
    return metrics


def _figures(odds: Float[np.ndarray, "n"], rows: Bool[np.ndarray, "n"]) -> dict[str, float]:
    """Return number and accuracy of some crops, and the same of those with odds of at least 9 to 1."""
    sure = rows & (np.abs(odds) >= np.log(9))
    return {
        "crops": int(rows.sum()),
        "right": float((odds[rows] > 0).mean()) if rows.any() else 0.0,
        "sure": float(sure.sum() / max(rows.sum(), 1)),
        "right_if_sure": float((odds[sure] > 0).mean()) if sure.any() else 0.0,
    }


def _card(config: TrainAxisConfig, metrics: dict[str, Any], trained: CalibratedNetwork, crops: int) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    rows = "\n".join(
        f"| {name} | {m['crops']} | {m['right']:.1%} | {m['sure']:.0%} | {m['right_if_sure']:.1%} |"
        for name, m in metrics.items()
        if isinstance(m, dict)
    )
    return _CARD.format(
        parameters=sum(p.numel() for p in trained.network.parameters()), temperature=trained.temperature,
        crops=crops, config=config, training=config.training, torch=provenance(config)["torch"].split("+")[0],
        rows=rows, spread=np.degrees(SPREAD),
    )  # fmt: skip


_CARD = """# Axis network

Estimates in which direction an object lies, from its base to its top: a distribution over 36 bins of the
direction relative to that of the view, from the same gravity-upright crop as the pose network and from its
mirror image. {parameters} parameters, float32 safetensors. Logits are divided by the temperature
{temperature:.2f}. The shape prior finds the axis; which of its ends is the top, it tells by necks, lids and
tapers alone. The network also sees print, caps, and the rest of the image.

**Training**: `nodeslam train axis --seed {training.seed}` with torch {torch}: {training.epochs} epochs of
AdamW with learning rate {training.learning_rate} and cosine decay, batch size {training.batch}, on a
CPU, in bfloat16 with float32 weights where it computes with that, else in float32.
Labels are wrapped Gaussians with a standard deviation of {spread:.0f}°; crops are
mirrored (which negates the direction), warped, shifted, truncated and recoloured.

**Data**: the {crops} crops of lying mugs, bottles and cans in {config.pictures} scenes as those of the pose
network (see `pose.md`), in which nothing stands upright and half of the objects are bottles.

**Evaluation** on what lies in {config.test} such scenes of the test families, single views, masks as
imperfect as those of training: how often the true one of the two directions along the axis is the likelier,
and the same where the odds are 9 to 1 or more.

| lying | crops | right | sure | right if sure |
| --- | --- | --- | --- | --- |
{rows}

**Limitations**: rendered images only. Ends of cans without a print, a ring or a taper are alike: the network
is not sure there.
"""
