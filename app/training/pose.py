"""`nodeslam train pose`: train and evaluate the network for class and resting pose in clutter.

The scenes are those of `nodeslam train detector`, with many of the objects on their sides and upside down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from app.jobs import Workers
from app.training.class_metrics import confusion_table
from app.training.crop_cycles import CalibratedNetwork, CropSplits, train_cycles
from app.training.crop_dataset import (
    LabelledCrops,
    Progress,
    Split,
    label_crops,
    perturb_masks,
    perturb_plane,
)
from app.training.detector_config import (
    RENDERING_SHARE,
    STACKED,
    TrainDetectorConfig,
    provenance,
    stage_progress,
)
from app.training.files import checksums
from app.training.resources import Resources
from app.training.scene_dataset import ASTRAY, SHARD, load_crops, training_scene_config
from app.training.shards import Contents, write_shards
from perception.detection.crop_training import CropSet, TrainingConfig
from perception.detection.tasks import POSE_LABELS, WEIGHTS_FILES
from perception.types import POSED_CLASSES

if TYPE_CHECKING:
    from sim_assets.datasets.labels import InstanceLabel

OTHER_POSE = len(POSED_CLASSES)  # label of what is no object
ELEVATION = (np.radians(25), np.radians(90))  # of the cameras, which look down on clutter
DISTANCE = (0.28, 1.0)  # [m] of the cameras


@dataclass(frozen=True)
class TrainPoseConfig(TrainDetectorConfig):
    """Configuration of the job; the defaults are those of the shipped weights."""

    pictures: int = 10000
    further: int = 0
    stacked: int = 9000
    training: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=22))
    second: TrainingConfig = field(default_factory=lambda: TrainingConfig(epochs=10, learning_rate=1e-3))


@dataclass(frozen=True)
class PoseMix:
    """Which objects are in the scenes, and how they rest.

    Attributes:
        posed: Share of the objects that do not stand upright.
        shares: Relative numbers of mugs, bowls, bottles and cans.
        folder: Name of the folder of the crops.
    """

    posed: float = 0.5
    shares: tuple[int, int, int, int] = (5, 2, 4, 5)
    folder: str = "pose_scenes"


@dataclass(frozen=True)
class PoseShard:
    """Crops of scenes that are rendered together.

    Attributes:
        path: File of the crops, for ``load_crops``.
        split: Families of objects and kinds of distractors.
        seed: Seed of the data set.
        number: Number of the shard in the data set.
        count: Number of images.
        mix: Objects of the scenes.
        has_stacks: Whether some images have objects on or in others.
    """

    path: Path
    split: Split
    seed: int
    number: int
    count: int
    mix: PoseMix = PoseMix()
    has_stacks: bool = False

    @property
    def files(self) -> tuple[Path]:
        """The file, for ``write_shards``."""
        return (self.path,)


def run(
    config: TrainPoseConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Render the data set, train the pose network and evaluate it on the test families.

    Writes `pose_scenes/`, checkpoint, `pose.safetensors` and `pose.md` to the folder.

    Returns:
        Metrics of the pose network (``pose_metrics``).
    """
    crops = posed_crops(config, out_dir, progress, resources.workers)
    part = stage_progress(progress, RENDERING_SHARE, 1.0)
    trained = train_cycles("pose", crops, pose_targets, config, out_dir, part, resources.processes)
    metrics = pose_metrics(crops.test, trained.probabilities(crops.test))
    if crops.second_test is not None:
        stacked = pose_metrics(crops.second_test, trained.probabilities(crops.second_test))
        metrics |= {"accuracy_with_stacks": stacked["accuracy"]}
    trained.save(out_dir / WEIGHTS_FILES["pose"], "pose", config)
    card = _card(config, metrics, trained, crops)
    (out_dir / "pose.md").write_text(card + checksums(out_dir / WEIGHTS_FILES["pose"]), "utf-8")
    return metrics


def posed_crops(
    config: TrainPoseConfig,
    out_dir: Path,
    progress: Progress | None,
    workers: Workers = Workers(),
    mix: PoseMix = PoseMix(),
) -> CropSplits:
    """Return the crops of each purpose, rendered to the folder of the mix or found there."""
    seed, folder = config.training.seed, out_dir / mix.folder
    rendering = stage_progress(progress, 0.0, RENDERING_SHARE)

    def crops(split: Split, pictures: int, seed: int, has_stacks: bool = False) -> LabelledCrops:
        shards = render_crops(folder, split, pictures, seed, workers, rendering, mix, has_stacks)
        return load_crops([shard.path for shard in shards])

    first = (
        crops("train", config.pictures, seed),
        crops("train", config.validation, seed + 1),  # other shapes than those of training
        crops("test", config.test, seed),
    )
    if not config.stacked:
        return CropSplits(*first)
    stacked = crops("train", config.stacked, seed + 3, True)
    return CropSplits(*first, stacked, crops("test", config.test, seed + 3, True))


def render_crops(
    folder: Path,
    split: Split,
    pictures: int,
    seed: int,
    workers: Workers = Workers(),
    progress: Progress | None = None,
    mix: PoseMix = PoseMix(),
    has_stacks: bool = False,
) -> list[PoseShard]:
    """Render random scenes and return the shards of their crops; existing ones are reused.

    Raises:
        PerceptionError: A shard could not be rendered.
    """
    shards = []
    for number in range(max(1, math.ceil(pictures / SHARD))):
        count = min(SHARD, pictures - number * SHARD)
        path = folder / f"crops_{split}_seed{seed}_n{count}_{number:03d}.npz"
        shards.append(PoseShard(path, split, seed, number, count, mix, has_stacks))
    write_shards(shards, render_shard, workers, f"rendering {split} scenes", progress)
    return shards


def render_shard(shard: PoseShard) -> Contents:
    """Render the scenes of a shard and return the content of its file of crops."""
    from sim_assets.datasets.training_scenes import TrainingScenes

    seed = np.random.SeedSequence([shard.seed, shard.number, shard.split == "test"])
    rng = np.random.default_rng(seed.spawn(1)[0])
    config = replace(
        training_scene_config(), toppled=0.0, posed=shard.mix.posed, shares=shard.mix.shares,
        stacked=STACKED if shard.has_stacks else 0.0, elevation=ELEVATION, distance=DISTANCE,
    )  # fmt: skip
    crops = []
    with TrainingScenes(shard.split, int(seed.generate_state(1)[0]), config) as source:
        for image in source.render(shard.count):
            masks = perturb_masks(image, rng, astray=ASTRAY)
            crops.append(label_crops(image, perturb_plane(image.plane, rng), masks, pose_index))
    return (LabelledCrops.concatenate(crops).packed(),)


def pose_index(item: InstanceLabel | None) -> int:
    """Return the index of an object's class and resting pose, OTHER_POSE for all but objects."""
    if item is None or item.category is None:
        return OTHER_POSE
    return POSED_CLASSES.index((item.category, item.resting))


def pose_targets(crops: LabelledCrops) -> CropSet:
    """Return the crops with one-hot classes and poses as targets."""
    return CropSet(crops.images, crops.context, np.eye(len(POSE_LABELS), dtype=np.float32)[crops.label])


def pose_metrics(crops: LabelledCrops, probabilities: Float[np.ndarray, "n 10"]) -> dict[str, Any]:
    """Return accuracies and the confusion matrix (rows: true) of poses on crops."""
    best = probabilities.argmax(1)
    size = len(POSE_LABELS)
    confusion = np.bincount(crops.label * size + best, minlength=size**2).reshape(size, size)
    return {
        "crops": len(crops),
        "accuracy": float((best == crops.label).mean()),
        "accuracy_per_pose": {
            name: float(confusion[i, i] / max(confusion[i].sum(), 1)) for i, name in enumerate(POSE_LABELS)
        },
        "confusion": confusion.tolist(),
    }


def _card(
    config: TrainPoseConfig, metrics: dict[str, Any], trained: CalibratedNetwork, crops: CropSplits
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    second = stacked = evaluated = ""
    if crops.second is not None:
        second = _SECOND.format(second=config.second)
        stacked = _STACKED.format(config=config, crops=len(crops.second), share=STACKED)
        evaluated = f", {metrics['accuracy_with_stacks']:.3f} on as many scenes with stacks in half of them"
    return _CARD.format(
        parameters=sum(p.numel() for p in trained.network.parameters()), temperature=trained.temperature,
        second=second, stacked=stacked, evaluated=evaluated, crops=len(crops.training),
        config=config, training=config.training, torch=provenance(config)["torch"].split("+")[0],
        confusion=confusion_table(POSE_LABELS, metrics["confusion"], metrics["accuracy_per_pose"]),
        m=metrics, posed=PoseMix.posed,
    )  # fmt: skip


_CARD = """# Pose network

Predicts class and resting pose of an object on a cluttered table, or that it is none, from the same
gravity-upright crop as the class network and from its mirror image. {parameters} parameters, float32
safetensors. Logits are divided by the temperature {temperature:.2f}; log-probabilities of several views are
averaged. It proposes which shapes in which poses are fitted; depth decides.

**Training**: `nodeslam train pose --seed {training.seed}` with torch {torch}: {training.epochs} epochs of
AdamW with learning rate {training.learning_rate} and cosine decay, batch size {training.batch}{second}, on a
CPU, in bfloat16 with float32 weights where it computes with that, else in float32.
Crops are mirrored, warped, shifted, truncated and recoloured.

**Data**: {crops} crops of {config.pictures} scenes as those of the detector (see `detector.md`), in which
{posed:.0%} of the objects do not stand upright: mugs and bowls upside down; mugs, bottles and cans on their
sides, at random rolls, handles of mugs beside them or above. A can upside down counts as upright.{stacked}

**Evaluation** on {m[crops]} masks, as imperfect as those of training, in {config.test} such scenes of the
test families and held-out distractors, single views: accuracy {m[accuracy]:.3f}{evaluated}.

{confusion}

**Limitations**: rendered images only; no leaning objects but in others, no bottles on their caps.
"""

_SECOND = """; a second
cycle of {second.epochs} epochs with learning rate {second.learning_rate}"""

_STACKED = """
The second cycle learns from {crops} crops of {config.stacked} other images, {share:.0%} of which show objects
that stand on or in others (`sim_assets/datasets/stacks.py`)."""
