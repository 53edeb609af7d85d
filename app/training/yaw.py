"""`nodeslam train yaw`: train and evaluate the network for the yaw of a mug's handle.

In the same folder as `nodeslam train detector` it uses the same rendered crops.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from app.training.crop_cycles import CalibratedNetwork, train_ensemble
from app.training.crop_dataset import LabelledCrops, Progress
from app.training.detector import render_data_sets
from app.training.detector_config import RENDERING_SHARE, TrainDetectorConfig, stage_progress
from app.training.files import checksums
from app.training.resources import Resources
from perception.detection.crop_training import CropSet, TrainingConfig, TrainingData
from perception.detection.tasks import WEIGHTS_FILES
from perception.detection.yaw import modes, soft_labels
from perception.types import CATEGORIES

HANDLE_VISIBLE = 0.01  # smallest share of a mug's visible points on a handle that counts as visible


@dataclass(frozen=True)
class TrainYawConfig(TrainDetectorConfig):
    """Configuration of the job; more epochs than for the detector, since only mugs are trained on."""

    further: int = 0
    stacked: int = 0
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=28))


def run(
    config: TrainYawConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Render the data set, train the yaw network and evaluate it on the test families.

    Writes `scenes/`, checkpoint, `yaw.safetensors` and `yaw.md` to the folder.

    Returns:
        Metrics of the yaw network (``yaw_metrics``).
    """
    crops = render_data_sets(config, out_dir, progress, resources.workers).crops()
    training, validation, test = (select_mugs(c) for c in (crops.training, crops.validation, crops.test))
    data = TrainingData(yaw_targets(training), yaw_targets(validation))
    part = stage_progress(progress, RENDERING_SHARE, 1.0)
    trained = train_ensemble("yaw", data, config, out_dir, part, resources.processes)
    metrics = yaw_metrics(test, trained.probabilities(test))
    trained.save(out_dir / WEIGHTS_FILES["yaw"], "yaw", config)
    card = _card(config, metrics, trained, len(training))
    (out_dir / "yaw.md").write_text(card + checksums(out_dir / WEIGHTS_FILES["yaw"]), "utf-8")
    return metrics


def select_mugs(crops: LabelledCrops) -> LabelledCrops:
    """Return the crops of mugs."""
    return crops.subset(crops.label == CATEGORIES.index("mug"))


def yaw_targets(crops: LabelledCrops) -> CropSet:
    """Return the crops with soft yaw bins as targets."""
    return CropSet(crops.images, crops.context, soft_labels(crops.yaw.astype(np.float64)))


def yaw_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n b"]) -> dict[str, Any]:
    """Return yaw errors (radians) of the first mode and of the best of three modes, by visibility."""
    peaks_of_crops = [modes(p, count=3, min_ratio=0.02) for p in probabilities]
    truth = crops.yaw.tolist()
    error = np.array([angle_between(peaks[0][0], yaw) for peaks, yaw in zip(peaks_of_crops, truth)])
    closest = np.array([
        min(angle_between(y, yaw) for y, _ in peaks) for peaks, yaw in zip(peaks_of_crops, truth)
    ])  # fmt: skip
    entropies = -(probabilities * np.log(np.clip(probabilities, 1e-12, None))).sum(1)
    metrics: dict[str, Any] = {"mugs": len(crops)}
    for name, rows in {
        "visible": crops.handle >= HANDLE_VISIBLE,
        "hidden": crops.handle < HANDLE_VISIBLE,
        "surest_80": entropies <= np.quantile(entropies, 0.8),
    }.items():
        metrics[name] = {
            "mugs": int(rows.sum()),
            "median": float(np.median(error[rows])),
            "over_15_degrees": float((error[rows] > np.radians(15)).mean()),
            "over_30_degrees": float((error[rows] > np.radians(30)).mean()),
            "no_mode_within_30_degrees": float((closest[rows] > np.radians(30)).mean()),
            "entropy": float(np.median(entropies[rows])),
        }
    return metrics


def angle_between(a: float, b: float) -> float:
    """Return the absolute difference of two angles in radians, at most pi."""
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def _card(config: TrainYawConfig, metrics: dict[str, Any], trained: CalibratedNetwork, mugs: int) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    rows = "\n".join(_row(name, m) for name, m in metrics.items() if isinstance(m, dict))
    return _CARD.format(
        parameters=sum(p.numel() for p in trained.network.parameters()),
        temperature=trained.temperature, mugs=mugs,
        training=config.training, config=config, torch=torch.__version__.split("+")[0], rows=rows,
        visible=HANDLE_VISIBLE,
    )  # fmt: skip


def _row(name: str, m: dict[str, Any]) -> str:
    cells = [name.replace("_", " "), str(m["mugs"]), f"{np.degrees(m['median']):.1f}°"]
    cells += [f"{m[key]:.1%}" for key in ("over_15_degrees", "over_30_degrees", "no_mode_within_30_degrees")]
    return "| " + " | ".join([*cells, f"{m['entropy']:.2f}"]) + " |"


_CARD = """# Yaw network

Estimates the direction of a mug's handle: a distribution over 36 bins of the yaw relative to the viewing
direction, from the same gravity-upright crop as the class network and from its mirror image. {parameters}
parameters, float32 safetensors. Logits are divided by the temperature {temperature:.2f}. The distribution
is wide where the handle is hidden; distributions of several views are multiplied.

**Training**: `nodeslam train yaw --seed {training.seed}` with torch {torch}: {training.epochs} epochs of
AdamW with learning rate {training.learning_rate} and cosine decay, batch size {training.batch}, on a
CPU, in bfloat16 with float32 weights where it computes with that, else in float32.
Labels are wrapped Gaussians with a standard deviation of 7°; crops are
mirrored (which negates the yaw), warped, shifted, truncated and recoloured.

**Data**: the {mugs} mugs in {config.pictures} scenes of the training families (see `detector.md`).

**Evaluation** on the mugs in {config.test} scenes of the test families (handle styles that are not in the
training families), single views. A handle counts as visible if at least {visible:.0%} of the mug's visible
points lie on it.

| mugs | number | median error | over 15° | over 30° | none of 3 modes within 30° | median entropy [nat] |
| --- | --- | --- | --- | --- | --- | --- |
{rows}

**Limitations**: rendered images only; upright mugs; a handle outside the image counts as hidden.
"""
