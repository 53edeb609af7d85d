"""`nodeslam train yaw`: train and evaluate the network for the yaw of a mug's handle.

In the same folder as `nodeslam train detector` it uses the same rendered crops. A second cycle learns from
scenes with more mugs, and from masks that end at their bodies.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from app.jobs import Workers
from app.training.crop_cycles import CalibratedNetwork, CropSplits, train_cycles
from app.training.crop_dataset import LabelledCrops, Progress, Split
from app.training.detector import render_data_sets
from app.training.detector_config import RENDERING_SHARE, STACKED, TrainDetectorConfig, stage_progress
from app.training.files import checksums
from app.training.resources import Resources
from app.training.scene_dataset import load_crops, render_shards
from perception.detection.crop_training import CropSet, TrainingConfig
from perception.detection.tasks import WEIGHTS_FILES
from perception.detection.yaw import modes, soft_labels
from perception.types import CATEGORIES

HANDLE_VISIBLE = 0.01  # smallest share of a mug's visible points on a handle that counts as visible


@dataclass(frozen=True)
class TrainYawConfig(TrainDetectorConfig):
    """Configuration of the job; more epochs than for the detector, since only mugs are trained on.

    Attributes:
        mugs: Number of images, most of whose objects are mugs, for the second cycle.
    """

    further: int = 0
    stacked: int = 0
    mugs: int = 6000
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=28))
    second: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=8, learning_rate=1e-3))


def run(
    config: TrainYawConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Render the data set, train the yaw network and evaluate it on the test families.

    Writes `scenes/`, `mug_scenes/`, checkpoints, `yaw.safetensors` and `yaw.md` to the folder.

    Returns:
        Metrics of the yaw network (``yaw_metrics``), and as ``bodies`` those with scenes and masks as in the
        second cycle.
    """
    crops = mug_crops(config, out_dir, progress, resources.workers)
    part = stage_progress(progress, RENDERING_SHARE, 1.0)
    trained = train_cycles("yaw", crops, yaw_targets, config, out_dir, part, resources.processes)
    metrics = yaw_metrics(crops.test, trained.probabilities(crops.test))
    if crops.second_test is not None:
        bodies = yaw_metrics(crops.second_test, trained.probabilities(crops.second_test))
        metrics |= {"bodies": bodies}
    trained.save(out_dir / WEIGHTS_FILES["yaw"], "yaw", config)
    card = _card(config, metrics, trained, crops)
    (out_dir / "yaw.md").write_text(card + checksums(out_dir / WEIGHTS_FILES["yaw"]), "utf-8")
    return metrics


def mug_crops(
    config: TrainYawConfig, out_dir: Path, progress: Progress | None, workers: Workers = Workers()
) -> CropSplits:
    """Return the crops of mugs of each purpose, rendered to the folder or found there."""
    more = config.mugs + config.test
    usual = config.pictures + config.validation + config.test
    share = usual / (usual + more) if config.mugs else 1.0
    splits = render_data_sets(config, out_dir, stage_progress(progress, 0.0, share), workers).crops()
    first = (splits.training, splits.validation, splits.test)
    if not config.mugs:
        return CropSplits(*(select_mugs(crops) for crops in first))
    ends = [RENDERING_SHARE * (usual + count) / (usual + more) for count in (0, config.mugs, more)]

    def mugs(split: Split, pictures: int, low: float, high: float) -> LabelledCrops:
        shards = render_shards(
            out_dir / "mug_scenes", split, pictures, config.training.seed + 4, workers,
            stage_progress(progress, low, high), crops_only=True, stacked=STACKED, mugs=True,
        )  # fmt: skip
        return load_crops([shard.crops for shard in shards])

    second = (mugs("train", config.mugs, *ends[:2]), mugs("test", config.test, *ends[1:]))
    return CropSplits(*(select_mugs(crops) for crops in (*first, *second)))


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


def _card(
    config: TrainYawConfig, metrics: dict[str, Any], trained: CalibratedNetwork, crops: CropSplits
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    rows = [_row(name, metrics[name]) for name in _ROWS]
    second = data = ""
    if crops.second is not None:
        rows += [_row(f"{name} (as in the second cycle)", metrics["bodies"][name]) for name in _ROWS]
        second = _SECOND.format(second=config.second)
        data = _MUGS.format(config=config, crops=len(crops.second), share=STACKED)
    return _CARD.format(
        parameters=sum(p.numel() for p in trained.network.parameters()), second=second, data=data,
        temperature=trained.temperature, mugs=len(crops.training), rows="\n".join(rows),
        training=config.training, config=config, torch=torch.__version__.split("+")[0],
        visible=HANDLE_VISIBLE,
    )  # fmt: skip


def _row(name: str, m: dict[str, Any]) -> str:
    cells = [name.replace("_", " "), str(m["mugs"]), f"{np.degrees(m['median']):.1f}°"]
    cells += [f"{m[key]:.1%}" for key in ("over_15_degrees", "over_30_degrees", "no_mode_within_30_degrees")]
    return "| " + " | ".join([*cells, f"{m['entropy']:.2f}"]) + " |"


_ROWS = ("visible", "hidden", "surest_80")
_SECOND = """; a second
cycle of {second.epochs} epochs with learning rate {second.learning_rate}"""
_MUGS = """
The second cycle learns from {crops} crops of {config.mugs} other images with nine mugs for each bowl, bottle
and can, {share:.0%} of which show objects that stand on or in others. Each mug with a handle in view has
a further crop there, with a mask that ends at its body, as the detector's does where a handle is hardly
measured."""

_CARD = """# Yaw network

Estimates the direction of a mug's handle: a distribution over 36 bins of the yaw relative to the viewing
direction, from the same gravity-upright crop as the class network and from its mirror image. {parameters}
parameters, float32 safetensors. Logits are divided by the temperature {temperature:.2f}. The distribution
is wide where the handle is hidden; distributions of several views are multiplied.

**Training**: `nodeslam train yaw --seed {training.seed}` with torch {torch}: {training.epochs} epochs of
AdamW with learning rate {training.learning_rate} and cosine decay, batch size {training.batch}{second}, on a
CPU, in bfloat16 with float32 weights where it computes with that, else in float32.
Labels are wrapped Gaussians with a standard deviation of 7°; crops are
mirrored (which negates the yaw), warped, shifted, truncated and recoloured.

**Data**: the {mugs} mugs in {config.pictures} scenes of the training families (see `detector.md`).{data}

**Evaluation** on the mugs in {config.test} scenes of the test families (handle styles that are not in the
training families), single views. A handle counts as visible if at least {visible:.0%} of the mug's visible
points lie on it.

| mugs | number | median error | over 15° | over 30° | none of 3 modes within 30° | median entropy [nat] |
| --- | --- | --- | --- | --- | --- | --- |
{rows}

**Limitations**: rendered images only; upright mugs; a handle outside the image counts as hidden.
"""
