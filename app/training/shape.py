"""``nodeslam train shape``: gather shapes, train the shape prior, write weights and a model card.

Shapes are sampled from the training families, or are a user's meshes; perception receives occupancy grids.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from app.jobs import Workers
from app.training.files import summary_writer
from app.training.mapped import Mapped, folder_of_arrays
from app.training.processes import Report, run_on_ranks
from app.training.resources import Resources
from app.training.shape_pictures import CODE, PIXEL, RECONSTRUCTIONS, WALK, draw_shape_pictures
from app.training.shape_samples import cached_shapes
from app.training.shards import Progress
from perception.distributed import Ranks
from perception.errors import PerceptionError
from perception.io.files import read_json, write_atomically, write_json
from perception.io.weights import weights_checksum
from perception.shape.dataset import ShapeDataset
from perception.shape.evaluation import OBJECT_VOXELS, ShapeScores, describe, evaluate
from perception.shape.network import ShapeVae
from perception.shape.training import EpochRecord, OnBatch, ShapeTrainingConfig, train
from perception.shape.weights import save_weights
from perception.types import CATEGORIES, Category

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainShapeConfig:
    """Settings of the training; the defaults reproduce the shipped weights.

    Attributes:
        mugs: Number of training mugs; the most, as handles are the most difficult structures.
        bowls: Number of training bowls.
        bottles: Number of training bottles.
        cans: Number of training cans.
        held_out: Number of evaluation shapes of each class, from the test families.
        meshes: Folder of meshes (see ``shape_meshes.py``) that replace the families; a tenth is held out.
        training: Settings of the optimisation.
        evaluate_every: Number of epochs between evaluations on the held-out shapes.
        tensorboard: Whether to write curves for TensorBoard (extra ``train``).
        device: "cpu" or "cuda".
    """

    mugs: int = 6000
    bowls: int = 3000
    bottles: int = 3000
    cans: int = 2500
    held_out: int = 200
    meshes: Path | None = None
    training: ShapeTrainingConfig = field(default_factory=ShapeTrainingConfig)
    evaluate_every: int = 5
    tensorboard: bool = False
    device: str = "cpu"

    @property
    def counts(self) -> dict[Category, int]:
        return {"mug": self.mugs, "bowl": self.bowls, "bottle": self.bottles, "can": self.cans}


def run(
    config: TrainShapeConfig,
    out_dir: Path,
    progress: Progress | None = None,
    resources: Resources = Resources(),
) -> dict[str, Any]:
    """Train into a folder: data, checkpoint, ``history.json``, ``shape.safetensors``, and ``shape.md``.

    An interrupted training continues after the last complete epoch; of a finished one only the evaluation and
    the model card are repeated.

    Returns:
        Metrics of the report: held-out scores by class, path and checksum of the weights, skipped meshes.
    """
    tell = progress or (lambda what, share: None)
    out_dir.mkdir(parents=True, exist_ok=True)
    seed = config.training.seed
    train_data, test_data, skipped = _shapes(config, out_dir, tell, resources.workers)

    def on_batch(epoch: int, done: int, batches: int) -> None:
        share = (epoch - 1 + done / batches) / config.training.epochs
        tell(f"epoch {epoch} of {config.training.epochs}", share)

    model = _fit(config, out_dir, (train_data, test_data), on_batch, resources.processes)
    scores = evaluate(model, test_data, config.device)
    weights = out_dir / "shape.safetensors"
    metadata = {
        "seed": str(seed),
        "epochs": str(config.training.epochs),
        "config": json.dumps(asdict(replace(config, meshes=None)) | {"meshes": config.meshes is not None}),
    }
    save_weights(model, weights, metadata)
    tell("drawing pictures", 1.0)
    draw_shape_pictures(model, test_data if len(test_data) else train_data, out_dir, config.device)
    write_atomically(out_dir / "shape.md", model_card(config, scores, weights, train_data))
    return {
        "skipped": list(skipped),
        "weights": str(weights),
        "sha256": weights_checksum(weights),
        "held_out": held_out(scores),
    }


def _shapes(
    config: TrainShapeConfig, out_dir: Path, tell: Progress, workers: Workers
) -> tuple[ShapeDataset, ShapeDataset, Sequence[str]]:
    """Return training shapes, held-out shapes and skipped meshes; the shapes are cached in the folder."""
    train_path, test_path = out_dir / "train_shapes.npz", out_dir / "test_shapes.npz"
    seed = config.training.seed
    if config.meshes is None:

        def sampling(what: str, share: float) -> None:
            tell(f"{what} ({share:.0%})", 0.0)

        tell("sampling shapes", 0.0)
        test_counts: dict[Category, int] = dict.fromkeys(CATEGORIES, config.held_out)
        train_data = cached_shapes(train_path, config.counts, "train", seed, workers, sampling)
        return train_data, cached_shapes(test_path, test_counts, "test", seed, workers, sampling), ()
    job = {"meshes": str(config.meshes.resolve()), "seed": seed}
    source = out_dir / "shapes.json"
    if source.exists() and train_path.exists() and test_path.exists():
        remedy = "delete the folder or choose another --out"
        found = read_json(source, remedy)
        if not isinstance(found, dict) or {key: found.get(key) for key in job} != job:
            raise PerceptionError(f"{source} belongs to other meshes or another seed; {remedy}")
        return ShapeDataset.load(train_path), ShapeDataset.load(test_path), found.get("skipped", ())
    from app.training.shape_meshes import load_shapes

    shapes = load_shapes(
        config.meshes, seed, lambda done, total: tell(f"reading mesh {done} of {total}", 0.0)
    )
    shapes.train.save(train_path)
    shapes.test.save(test_path)
    write_json(source, {**job, "skipped": list(shapes.skipped)})
    return shapes.train, shapes.test, shapes.skipped


def held_out(scores: dict[Category, ShapeScores]) -> dict[str, dict[str, float | None]]:
    """Return the scores as JSON values; null where a class has no handles or a shape no surface."""
    return {
        category: {name: value if np.isfinite(value) else None for name, value in asdict(s).items()}
        for category, s in scores.items()
    }


def _fit(
    config: TrainShapeConfig,
    out_dir: Path,
    data: tuple[ShapeDataset, ShapeDataset],
    on_batch: OnBatch,
    processes: int,
) -> ShapeVae:
    """Train on the first data set, evaluating on the second; several processes end with the checkpoint."""
    training, test = data
    checkpoint = out_dir / "checkpoint.pt"
    if processes == 1:
        on_epoch = _Watcher(config, out_dir, test).on_epoch
        return train(training, config.training, config.device, checkpoint, on_epoch, on_batch)
    with folder_of_arrays(out_dir) as folder:
        mapped = Mapped.write(training, folder / "training"), Mapped.write(test, folder / "test")
        run_on_ranks(_fit_on_rank, (config, out_dir, *mapped), processes, config.device, on_batch)
    return train(training, config.training, config.device, checkpoint)


_Work = tuple[TrainShapeConfig, Path, Mapped[ShapeDataset], Mapped[ShapeDataset]]


def _fit_on_rank(work: _Work, ranks: Ranks, report: Report) -> None:
    """Train in one of several processes; the first evaluates, writes and reports."""
    config, out_dir, training, test = work
    on_epoch = _Watcher(config, out_dir, test.open()).on_epoch if ranks.is_first else None
    on_batch = report if ranks.is_first else None
    checkpoint = out_dir / "checkpoint.pt"
    train(training.open(), config.training, config.device, checkpoint, on_epoch, on_batch, ranks)


class _Watcher:
    """Writes the results of each epoch to ``history.json``, and TensorBoard curves if enabled."""

    def __init__(self, config: TrainShapeConfig, out_dir: Path, test_data: ShapeDataset) -> None:
        self._config, self._test_data = config, test_data
        self._path = out_dir / "history.json"
        remedy = "delete the folder or choose another --out"
        self._history: list[dict[str, Any]] = read_json(self._path, remedy) if self._path.exists() else []
        self._curves = summary_writer(out_dir) if config.tensorboard else None

    def on_epoch(self, record: EpochRecord, model: ShapeVae) -> None:
        entry: dict[str, Any] = asdict(record)
        if record.epoch % self._config.evaluate_every == 0:
            scores = evaluate(model, self._test_data, self._config.device, max_surfaces=40)
            entry["held_out"] = held_out(scores)
            logger.info("epoch %d: loss %.1f; %s", record.epoch, record.loss, describe(scores))
        before = [kept for kept in self._history if kept["epoch"] < record.epoch]  # killed in this epoch
        self._history = [*before, entry]
        write_json(self._path, self._history)
        if self._curves is not None:
            self._curves.add_scalar("loss", record.loss, record.epoch)
            self._curves.add_scalar("divergence", record.divergence, record.epoch)
            for category, values in entry.get("held_out", {}).items():
                self._curves.add_scalar(f"iou/{category}", values["iou"], record.epoch)
            self._curves.flush()


def model_card(
    config: TrainShapeConfig, scores: dict[Category, ShapeScores], weights: Path, data: ShapeDataset
) -> str:
    """Return the model card in Markdown: architecture, training, data, evaluation and limitations."""
    rows = []
    for category, s in scores.items():
        recall = "–" if np.isnan(s.handle_recall) else f"{100 * s.handle_recall:.0f} %"
        millimetres = 100 * s.surface / OBJECT_VOXELS
        cells = (
            category,
            f"{s.iou:.3f}",
            f"{s.surface:.2f}",
            f"{millimetres:.2f}",
            recall,
            f"{s.code_spread:.2f}",
        )
        rows.append(f"| {' | '.join(cells)} |")
    return _CARD.format(
        parameters=sum(parameter.numel() for parameter in ShapeVae().parameters()),
        megabytes=weights.stat().st_size / 1e6,
        checksum=weights_checksum(weights),
        counts=", ".join(f"{len(data.of(category))} {category}s" for category in CATEGORIES),
        source=_FAMILIES if config.meshes is None else _MESHES,
        held_out=_HELD_OUT.format(config=config) if config.meshes is None else _HELD_OUT_MESHES,
        command="nodeslam train shape" + ("" if config.meshes is None else " --meshes DIR"),
        pictures=(RECONSTRUCTIONS, WALK, PIXEL, CODE),
        training=config.training,
        loss=config.training.loss,
        torch=torch.__version__.split("+")[0],
        rows="\n".join(rows),
    )


_FAMILIES = """sampled with the seed above from the
training families of `sim_assets/objects`: procedural shapes only, no scanned object. Some have
the proportions met in homes, and some cans and bottles sides of free form
(`sim_assets/objects/training_grids.py`)"""
_MESHES = "from a user's folder of meshes"
_HELD_OUT = """{config.held_out} shapes of each class from the test families (other handle styles and
profiles)"""
_HELD_OUT_MESHES = "a tenth of each class"

_CARD = """# Shape prior

Class-conditional variational autoencoder of 32³ occupancy grids of mugs, bowls, bottles and cans, with a
latent code of 16 entries (`perception/shape/network.py`). {parameters} parameters in encoder and decoder,
float16 safetensors, {megabytes:.1f} MB, SHA-256 `{checksum}`.

**Training**: `{command} --seed {training.seed}` with torch {torch}: {training.epochs} epochs, Adam with
learning rate {training.learning_rate} and cosine decay, batch size {training.batch_size}, float32. KL
weight {loss.beta}; voxels at structures thinner than three voxels have weight 1 + {loss.thin}, those at mug
handles a further {loss.handle}.

**Data**: {counts}, {source}. Bowls, bottles and cans are mirrored at random.

**Evaluation**: {held_out}, encoded and decoded. Medians (handles: mean); surfaces at occupancy 0.5, for 100
shapes of each class. A voxel is 1/28.8 of the longest side, 3.5 mm for a 100 mm object. The root mean
square of the code is 1 where codes follow the prior.

| class | IoU | surface error [voxel] | surface error at 100 mm [mm] | handle within 1.5 voxels | code RMS |
| --- | --- | --- | --- | --- | --- |
{rows}

![Held-out shapes above, their reconstructions by encoder and decoder below]({pictures[0]})

Held-out shapes (above) and their reconstructions by encoder and decoder (below).

![Nine steps between the codes of two held-out shapes, for each class]({pictures[1]})

Linear interpolation between the codes of two held-out shapes, for each class.

![A rendered pixel and its derivative with respect to the occupancies]({pictures[2]})

The derivative of one rendered depth (red ring) with respect to the occupancies along its ray, seen from the
side: a higher occupancy reduces the depth, most of all in front.

![A rendered object and its derivative with respect to the code]({pictures[3]})

A rendered object: depth, its standard deviation, and the derivative of the depth with respect to the ten
code entries with the largest effect (red: nearer, blue: farther).

The IoU is low where walls are about one voxel thick: an error of a quarter of a voxel is then a quarter of
the volume.

**Limitations**: walls thinner than half a voxel (1.7 mm of 100 mm) decode to occupancies below 0.5; handles
unlike those of the training data are blurred; ribs, spouts, lugs, lids and objects that do not stand
upright are not in the families.
"""
