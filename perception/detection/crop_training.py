"""Training of the crop networks: cross-entropy with one-hot classes or soft bins of directions.

The data set is given as arrays (``app.training.crop_dataset`` renders it).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from perception.detection.crop_augmentation import (
    Draws,
    mirror_crops,
    perturb_crops,
    truncate_crops,
    warp_crops,
)
from perception.detection.crop_network import (
    CropNet,
    CropNetwork,
    create_member,
    members_of,
    mirror_averaged_logits,
    normalise_crops,
)
from perception.detection.tasks import DIRECTIONS, OUTPUTS, Task
from perception.detection.training_state import (
    TrainingState,
    mixed_precision,
    resume_checkpoint,
    save_checkpoint,
)
from perception.detection.yaw import YAW_BINS
from perception.distributed import Ranks
from perception.errors import InvalidInputError
from perception.types import OTHER

logger = logging.getLogger(__name__)
TrainingProgress = Callable[[int, int, dict[str, float]], None]  # steps done, steps in total, metrics


@dataclass(frozen=True)
class CropSet:
    """Crops with training targets.

    Attributes:
        images: (n, SIDE, SIDE, 6) uint8 as in ``crops.Crop``.
        context: (n, 2) float32 as in ``crops.Crop``.
        targets: (n, k) float32 target distributions: one-hot classes, or soft bins of directions.
    """

    images: UInt8[np.ndarray, "n side side 6"]
    context: Float[np.ndarray, "n 2"]
    targets: Float[np.ndarray, "n k"]

    def __len__(self) -> int:
        return len(self.images)

    def subset(self, rows: Int[np.ndarray, "m"]) -> CropSet:
        """Return the crops of the given rows."""
        return CropSet(self.images[rows], self.context[rows], self.targets[rows])


@dataclass(frozen=True)
class TrainingConfig:
    """Hyperparameters of a crop network.

    Attributes:
        epochs: Number of passes over the crops.
        batch: Number of crops per step.
        learning_rate: Peak of the cosine schedule.
        warmup: Share of the steps with linear warm-up.
        weight_decay: Weight decay of AdamW.
        label_smoothing: Share of the target distributed evenly over the classes; not of directions.
        seed: Seed of initialisation, order and augmentation.
    """

    epochs: int = 5
    batch: int = 128
    learning_rate: float = 2e-3
    warmup: float = 0.05
    weight_decay: float = 1e-2
    label_smoothing: float = 0.02
    seed: int = 0


@dataclass(frozen=True)
class TrainingData:
    """Crops to train on, and crops of the same families for validation and calibration."""

    training: CropSet
    validation: CropSet


@dataclass(frozen=True)
class TrainingJob:
    """Where a network is trained, and how its progress is reported.

    Attributes:
        directory: Folder of the checkpoint.
        device: Torch device.
        progress: Called with (epochs or steps done, their total number, metrics), in the first process.
        ranks: Processes that share each batch; the first writes the checkpoint.
        start: Network whose weights training starts from; random ones if None.
    """

    directory: Path
    device: str | torch.device = "cpu"
    progress: TrainingProgress | None = None
    ranks: Ranks = Ranks()
    start: CropNet | None = None


def train_crop_network(task: Task, data: TrainingData, config: TrainingConfig, job: TrainingJob) -> CropNet:
    """Train a network, resuming from ``checkpoint_<task>.pt`` in the job's folder if it exists.

    Args:
        task: What the network predicts.
        data: Crops to train on, and crops for the metrics after each epoch.
        config: Hyperparameters.
        job: Folder and device; progress is reported after every epoch.

    Returns:
        The network in evaluation mode.

    Raises:
        InvalidInputError: A set is empty or its targets have the wrong width.
        PerceptionError: The checkpoint belongs to another configuration.
    """
    training, validation = data.training, data.validation
    for name, crops in (("training", training), ("validation", validation)):
        if not len(crops) or crops.targets.shape[1] != OUTPUTS[task]:
            raise InvalidInputError(f"{name} crops for '{task}' must have (n > 0, {OUTPUTS[task]}) targets")
    state = _initial_state(task, config, math.ceil(len(training) / config.batch), job)
    checkpoint = job.directory / f"checkpoint_{task}.pt"
    start = resume_checkpoint(checkpoint, state)

    network = job.ranks.parallel(state.network)

    for epoch in range(start, config.epochs):
        loss = _train_epoch(task, training, config, state, network, job.ranks)
        if not job.ranks.is_first:
            continue
        metrics = {"loss": loss, **validation_metrics(task, state.network, validation)}
        save_checkpoint(checkpoint, state, epoch + 1)
        logger.info("%s epoch %d: %s", task, epoch + 1, metrics)
        if job.progress:
            job.progress(epoch + 1, config.epochs, metrics)
    return state.network.eval()


def _initial_state(
    task: Task, config: TrainingConfig, steps_per_epoch: int, job: TrainingJob
) -> TrainingState[CropNet]:
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = create_member(task)
    if job.start is not None:
        network.load_state_dict(job.start.state_dict())
    network = network.to(job.device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay
    )
    steps = config.epochs * steps_per_epoch
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: learning_rate_share(step / steps, config.warmup)
    )
    return TrainingState(repr(config), network, optimizer, schedule, generator)


def learning_rate_share(done: float, warmup: float) -> float:
    """Return the learning rate relative to its peak: linear warm-up, then a cosine down to 0.01.

    Args:
        done: Share of the steps that are done.
        warmup: Share of the steps with warm-up.
    """
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, (done - warmup) / (1 - warmup))))


def _train_epoch(
    task: Task,
    crops: CropSet,
    config: TrainingConfig,
    state: TrainingState[CropNet],
    network: nn.Module,
    ranks: Ranks,
) -> float:
    """Train for one epoch and return the mean loss; ``network`` is the state's, or parallel around it."""
    network.train()
    device = next(network.parameters()).device
    order = torch.randperm(len(crops), generator=state.generator).numpy()
    total = 0.0
    for rows in np.array_split(order, max(1, round(len(order) / config.batch))):
        share = ranks.share(len(rows))
        draws = Draws(state.generator, len(rows), share)
        batch = crops.subset(np.sort(rows)[share])
        images = torch.from_numpy(batch.images).to(device)
        context, targets = (torch.from_numpy(a).to(device) for a in (batch.context, batch.targets))
        images, targets = mirror_crops(task, images, targets, draws)
        inputs = warp_crops(normalise_crops(truncate_crops(images, draws)), draws)
        inputs, context = perturb_crops(inputs, context, draws)
        if task not in DIRECTIONS:
            targets = (1 - config.label_smoothing) * targets + config.label_smoothing / targets.shape[1]
        with mixed_precision(device):
            logits = network(inputs, context)
        mean = functional.cross_entropy(logits.float(), targets) if len(batch) else logits.float().sum()
        loss = ranks.weighted(mean, len(batch), len(rows))
        state.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        state.optimizer.step()
        state.schedule.step()
        total += loss.item() * len(rows)
    return (
        float(ranks.total(torch.tensor(total, dtype=torch.float64, device=device))) / ranks.count / len(order)
    )


@torch.inference_mode()
def _logits(network: CropNetwork, crops: CropSet, batch: int = 512) -> Tensor:
    network.eval()
    device = next(network.parameters()).device
    rows = []
    for start in range(0, len(crops), batch):
        images = normalise_crops(torch.from_numpy(crops.images[start : start + batch]).to(device))
        context = torch.from_numpy(crops.context[start : start + batch]).to(device)
        rows.append(mirror_averaged_logits(network, images, context).float().cpu())
    return torch.cat(rows)


def validation_metrics(task: Task, network: CropNetwork, crops: CropSet) -> dict[str, float]:
    """Return cross-entropy and accuracy; of directions the median error of the best bin, in rad."""
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    metrics = {"validation_loss": float(functional.cross_entropy(logits, targets))}
    best, true = logits.argmax(1), targets.argmax(1)
    if task not in DIRECTIONS:
        return metrics | {"accuracy": float((best == true).double().mean())}
    error = ((best - true + YAW_BINS // 2) % YAW_BINS - YAW_BINS // 2).abs() * (2 * math.pi / YAW_BINS)
    return metrics | {f"{task}_median": float(error.median())}


def calibrated_temperature(network: CropNetwork, crops: CropSet) -> float:
    """Return the temperature of least cross-entropy on held-out crops, by grid search over 0.3 to 3.

    Temperature scaling: Guo et al., "On calibration of modern neural networks", ICML 2017.
    """
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    grid = np.geomspace(0.3, 3.0, 60)
    losses = [float(functional.cross_entropy(logits / t, targets)) for t in grid]
    return float(grid[int(np.argmin(losses))])


@torch.no_grad()
def equalise_priors(network: CropNetwork, targets: Float[np.ndarray, "n 5"]) -> None:
    """Shift the logits of the object classes in place as if all were equally frequent in the training data.

    The shift is the negative logarithm of a class's frequency relative to their mean (logit adjustment:
    Menon et al., "Long-tail learning via logit adjustment", ICLR 2021). That of 'other' stays.

    Args:
        network: Network or ensemble trained on the targets.
        targets: One-hot classes.
    """
    counts = targets[:, :OTHER].sum(axis=0)
    shift = torch.from_numpy(np.append(np.log(counts.mean() / np.maximum(counts, 1.0)), 0.0)).float()
    for member in members_of(network):
        bias = member.logits.bias
        bias += shift.to(bias.device)
