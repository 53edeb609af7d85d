"""`nodeslam train detector`: render the training families, train the scene and class networks, evaluate them.

Writes weights, model card and metrics. Rendered data and checkpoints stay in the folder, so that the same
command resumes an interrupted run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from app.jobs import Workers
from app.training.class_metrics import class_metrics
from app.training.crop_dataset import LabelledCrops, Progress, Split
from app.training.files import checksums, summary_writer
from app.training.fitting import fit_crop_network, fit_scene_network
from app.training.resources import Resources
from app.training.scene_dataset import (
    LabelledScenes,
    Shard,
    load_crops,
    load_scenes,
    render_shards,
)
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
    TrainingConfig,
    TrainingData,
    TrainingJob,
    calibrated_temperature,
    equalise_priors,
)
from perception.detection.detector import SCENE_SHARE as SCENE_WEIGHT
from perception.detection.scene_network import SceneNet, save_scene_network
from perception.detection.scene_training import SceneTrainingConfig
from perception.detection.tasks import ENSEMBLE_SIZE, LABELS, SCENE_WEIGHTS_FILE, WEIGHTS_FILES, Task

logger = logging.getLogger(__name__)
RENDERING_SHARE, SCENE_SHARE = 0.25, 0.9  # progress of the job after rendering and after the scene network
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
    """Labelled crops of each purpose; all but those of the tests are of the training families."""

    training: LabelledCrops
    validation: LabelledCrops
    test: LabelledCrops
    stacked: LabelledCrops | None = None
    stacked_test: LabelledCrops | None = None


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
    if crops.stacked_test is not None:
        stacked = class_metrics(crops.stacked_test, trained.probabilities(crops.stacked_test))
        metrics |= {"accuracy_with_stacks": stacked["accuracy"]}
    trained.save(out_dir / WEIGHTS_FILES["class"], "class", config)
    card = _card(config, metrics, scene, trained, crops)
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


def stage_progress(progress: Progress | None, low: float, high: float) -> Progress:
    """Return a callback that maps the progress of a stage to the share ``low`` to ``high`` of the job."""
    return lambda what, share: _report(progress, what, low + (high - low) * share)


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
        _report(progress, f"scenes, step {step} of {steps}", share)

    return fit_scene_network(scenes, settings, TrainingJob(out_dir, config.device, on_step), processes)


def train_cycles(
    task: Task,
    crops: CropSplits,
    targets: Callable[[LabelledCrops], CropSet],
    config: TrainDetectorConfig,
    out_dir: Path,
    progress: Progress | None,
    processes: int = 1,
) -> CalibratedNetwork:
    """Train a network in one cycle, or in a second one on images with stacks too.

    The second cycle has its checkpoint in the subfolder `second`.
    """
    validation = targets(crops.validation)
    data = TrainingData(targets(crops.training), validation)
    if crops.stacked is None:
        return train_ensemble(task, data, config, out_dir, progress, processes)
    samples = [len(crops.training) * config.training.epochs, len(crops.stacked) * config.second.epochs]
    share = samples[0] / sum(samples)
    first = train_ensemble(task, data, config, out_dir, stage_progress(progress, 0.0, share), processes)
    data = TrainingData(targets(crops.stacked), validation)
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
            _report(progress, f"epoch {done} of {total}", done / total)
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


def _report(progress: Progress | None, what: str, share: float) -> None:
    if progress:
        progress(what, share)


def class_targets(crops: LabelledCrops) -> CropSet:
    """Return the crops with one-hot class targets."""
    return CropSet(crops.images, crops.context, np.eye(len(LABELS), dtype=np.float32)[crops.label])


def provenance(config: TrainDetectorConfig) -> dict[str, str]:
    """Return the metadata of a weights file."""
    return {"seed": str(config.training.seed), "config": repr(config), "torch": torch.__version__}


def _card(
    config: TrainDetectorConfig,
    metrics: dict[str, Any],
    scene: SceneNet,
    trained: CalibratedNetwork,
    crops: CropSplits,
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    header = "| true \\ predicted | " + " | ".join(LABELS) + " | right |\n|" + " --- |" * (len(LABELS) + 2)
    rows = "\n".join(
        f"| {name} | " + " | ".join(str(n) for n in row) + f" | {metrics['accuracy_per_class'][name]:.3f} |"
        for name, row in zip(LABELS, metrics["confusion"])
    )
    second = stacked = evaluated = ""
    if crops.stacked is not None:
        second = _SECOND.format(second=config.second)
        stacked = _STACKED.format(config=config, crops=len(crops.stacked), share=STACKED)
        evaluated = f", {metrics['accuracy_with_stacks']:.3f} on as many scenes with stacks in half of them"
    return _CARD.format(
        scene_parameters=sum(p.numel() for p in scene.parameters()),
        parameters=sum(p.numel() for p in trained.network.parameters()),
        temperature=trained.temperature, crops=len(crops.training),
        second=second, stacked=stacked, evaluated=evaluated,
        class_share=1 - SCENE_WEIGHT, instance_share=SCENE_WEIGHT,
        config=config, training=config.training,
        scene_epochs=config.scene_epochs, torch=torch.__version__.split("+")[0],
        confusion=f"{header}\n{rows}", m=metrics,
    )  # fmt: skip


_CARD = """# Detector: instance network and class network

**Instance network** (`scene.safetensors`): predicts for every pixel of a 320-pixel view (colour, height
above the support plane, and scale) whether it belongs to an object, of which class, and the position of its
object's footprint in the plane; instances are the clusters of these votes
(`perception/detection/instances.py`). {scene_parameters} parameters, float16.

**Class network** (`detector.safetensors`): classifies a gravity-upright crop of 64 x 64 pixels around one
instance (colour, mask, height, relative depth, and the surroundings, `perception/detection/crops.py`, with
the crop's size and elevation) as mug, bowl, bottle, can or other. {parameters} parameters, float32. Logits
are averaged over the crop and its mirror image, shifted as if all classes were equally frequent in
training, and divided by the temperature {temperature:.2f}, which was fitted on further scenes of the
training families. The detector averages the log-probabilities of class and instance networks with weights of
{class_share:.2f} and {instance_share:.2f}; masks from other sources are classified by the class network
alone.

**Training**: `nodeslam train detector --seed {training.seed}` with torch {torch}: {scene_epochs} epochs of
the instance network with batch size 8, {training.epochs} of the class network with batch size
{training.batch}, AdamW with learning rate {training.learning_rate} and cosine decay{second}. On a CPU, in
bfloat16 with float32 weights where the CPU computes with it, else in float32.

**Data**: {config.pictures} scenes with objects of the training families and distractors, rendered at 640 x
480 by MuJoCo's classic renderer (`sim_assets/datasets/training_scenes.py`): seven in ten objects in the
sizes met in homes; two in five cans and bottles with sides of free form; some objects filled, lying or
upside down (those without a class); cartons, books, tools, desk and kitchen things, random shapes and odd
vessels; tables, floors, walls and furniture around, which is neither object nor background; random
textures, prints, gloss, lights and cameras (0.3 to 1.4 m, never nearer than their sensor measures); gaps
down to contact; depth of structured light, active stereo and time of flight
(`sim_assets/rendering/depth_noise.py`), half of it with errors of calibration between colour and depth. The
images are mirrored, recoloured, and lose further depth. From these images and {config.further} more of
their kind {crops} crops for the class network: the true masks made ragged, truncated, incomplete, or extended
by a part of a neighbour; crops are mirrored, warped, shifted, truncated and recoloured.{stacked} No
photographs.

**Evaluation of the class network** on {m[crops]} such masks in {config.test} such scenes of the test
families and held-out distractors, single views: accuracy {m[accuracy]:.3f}{evaluated}; of objects alone
{m[accuracy_objects]:.3f}; distractors classified as objects {m[distractors_taken_for_objects]:.3f}, objects
classified as other {m[objects_taken_for_distractors]:.3f}; expected calibration error
{m[calibration_error]:.3f}.

{confusion}

`nodeslam evaluate detection` evaluates the whole detector.

**Limitations**: upright objects, on a plane or on and in each other. Most errors occur with strong occlusion
and with parts truncated by the image border. Clear glass and real images are not in the training data, stacks
not in those of the instance network.
"""

_SECOND = """; the class network goes on in a second
cycle of {second.epochs} epochs with learning rate {second.learning_rate}"""

_STACKED = """
The second cycle learns from {crops} crops of {config.stacked} other images, {share:.0%} of which show objects
that stand on or in others (`sim_assets/datasets/stacks.py`)."""
