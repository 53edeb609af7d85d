"""Training of the crop networks: cross-entropy with one-hot classes or with soft yaw bins.

The data set is given as arrays (``app.training.crop_dataset`` renders it). The last checkpoint contains the
complete state, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from perception.detection.crop_network import (
    OUTPUTS,
    CropNet,
    CropNetwork,
    Task,
    mirror_averaged_logits,
    mirror_yaw_bins,
    normalise_crops,
)
from perception.detection.yaw import YAW_BINS
from perception.errors import InvalidInputError, PerceptionError

logger = logging.getLogger(__name__)
TrainingProgress = Callable[[int, int, dict[str, float]], None]  # steps done, steps in total, metrics


@dataclass(frozen=True)
class CropSet:
    """Crops with training targets.

    Attributes:
        images: (n, SIDE, SIDE, 6) uint8 as in ``crops.Crop``.
        context: (n, 2) float32 as in ``crops.Crop``.
        targets: (n, k) float32 target distributions: one-hot classes, or soft yaw bins.
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
        label_smoothing: Share of the target distributed evenly over the classes; class network only.
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
        progress: Called with (epochs or steps done, their total number, metrics).
    """

    directory: Path
    device: str | torch.device = "cpu"
    progress: TrainingProgress | None = None


Net = TypeVar("Net", bound=torch.nn.Module)


@dataclass(frozen=True)
class TrainingState(Generic[Net]):
    """Everything that changes during training, and the configuration it belongs to.

    Attributes:
        config: ``repr`` of the configuration.
        network: Network in training.
        optimizer: Optimizer of its parameters.
        schedule: Learning-rate schedule of the optimizer.
        generator: Source of randomness for order and augmentation.
    """

    config: str
    network: Net
    optimizer: torch.optim.Optimizer
    schedule: torch.optim.lr_scheduler.LRScheduler
    generator: torch.Generator


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
    state = _initial_state(OUTPUTS[task], config, math.ceil(len(training) / config.batch), job.device)
    checkpoint = job.directory / f"checkpoint_{task}.pt"
    start = resume_checkpoint(checkpoint, state)

    for epoch in range(start, config.epochs):
        loss = _train_epoch(task, training, config, state)
        metrics = {"loss": loss, **validation_metrics(task, state.network, validation)}
        save_checkpoint(checkpoint, state, epoch + 1)
        logger.info("%s epoch %d: %s", task, epoch + 1, metrics)
        if job.progress:
            job.progress(epoch + 1, config.epochs, metrics)
    return state.network.eval()


def _initial_state(
    outputs: int, config: TrainingConfig, steps_per_epoch: int, device: str | torch.device
) -> TrainingState[CropNet]:
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = CropNet(outputs)
    network = network.to(device)
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


def _train_epoch(task: Task, crops: CropSet, config: TrainingConfig, state: TrainingState[CropNet]) -> float:
    """Train for one epoch and return the mean loss."""
    network, generator = state.network, state.generator
    network.train()
    device = next(network.parameters()).device
    order = torch.randperm(len(crops), generator=generator).numpy()
    total = 0.0
    for rows in np.array_split(order, max(1, round(len(order) / config.batch))):
        batch = crops.subset(np.sort(rows))
        images = torch.from_numpy(batch.images).to(device)
        context, targets = (torch.from_numpy(a).to(device) for a in (batch.context, batch.targets))
        images, targets = mirror_crops(task, images, targets, generator)
        inputs = warp_crops(normalise_crops(truncate_crops(images, generator)), generator)
        inputs, context = perturb_crops(inputs, context, generator)
        if task == "class":
            targets = (1 - config.label_smoothing) * targets + config.label_smoothing / targets.shape[1]
        loss = functional.cross_entropy(network(inputs, context), targets)
        state.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        state.optimizer.step()
        state.schedule.step()
        total += loss.item() * len(rows)
    return total / len(order)


def mirror_crops(
    task: Task, images: Tensor, targets: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Flip half of the crops left to right; their yaw relative to the view changes its sign."""
    flip = torch.rand(len(images), generator=generator).to(images.device) < 0.5
    images = torch.where(flip[:, None, None, None], images.flip(2), images)
    if task == "yaw":
        targets = torch.where(flip[:, None], mirror_yaw_bins(targets), targets)
    return images, targets


def truncate_crops(
    images: UInt8[Tensor, "n side side 6"], generator: torch.Generator
) -> UInt8[Tensor, "n side side 6"]:
    """Set a band along one side to 0 in three of ten crops, as if the image border truncated them."""
    n, side = images.shape[:2]
    draw = torch.rand(n, 4, generator=generator).to(images.device)
    ramp = torch.arange(side, device=images.device)
    ramp = torch.where((draw[:, 1] < 0.5)[:, None], ramp, side - 1 - ramp)  # from either side
    kept = (ramp >= (0.4 * side * draw[:, 0])[:, None]) | (draw[:, 3] > 0.3)[:, None]  # (n, side)
    along_rows = (draw[:, 2] < 0.5)[:, None, None]
    return images * torch.where(along_rows, kept[:, :, None], kept[:, None, :])[..., None]


def warp_crops(
    inputs: Float[Tensor, "n 6 side side"], generator: torch.Generator, most: float = 0.05
) -> Float[Tensor, "n 6 side side"]:
    """Deform the shapes: width varying with height, height, shear and shift.

    This imitates shapes outside the training families and, by the shift, inexact bounding boxes of masks.

    Args:
        inputs: Normalised crops.
        generator: Source of randomness.
        most: Largest relative change of width, height and shear; the shift is at most 2.5 times as much of
            half the crop's side.
    """
    n, _, side, _ = inputs.shape
    draw = (2 * torch.rand(n, 9, generator=generator) - 1).to(inputs.device) * most
    across = torch.linspace(-1, 1, side, device=inputs.device)
    wider = functional.interpolate(draw[:, None, :5], side, mode="linear", align_corners=True)[:, 0]
    left, lean, up, higher = (draw[:, k, None, None] for k in (5, 6, 7, 8))
    u = across * (1 + wider[:, :, None]) + lean * across[:, None] + 2.5 * left  # (n, rows, columns)
    v = (across[:, None] * (1 + higher) + 2.5 * up).expand_as(u)
    grid = torch.stack([u, v], dim=-1)
    return functional.grid_sample(inputs, grid, padding_mode="border", align_corners=True)


def perturb_crops(
    inputs: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"], generator: torch.Generator
) -> tuple[Float[Tensor, "n 6 side side"], Float[Tensor, "n 2"]]:
    """Vary colours (``vary_colours``) and add noise to heights, depths, crop size and elevation."""
    n, _, side, _ = inputs.shape
    draw = torch.rand(n, 3, generator=generator).to(inputs.device) * 2 - 1  # uniform in -1..1
    noise = torch.randn(n, 1, side, side, generator=generator).to(inputs.device)
    noise = noise * (0.03 * draw[:, :1].abs())[..., None, None]  # decimetres; larger depth is smaller height
    colours = vary_colours(inputs[:, :3], generator)
    out = torch.cat([colours, inputs[:, 3:4], inputs[:, 4:5] - noise, inputs[:, 5:6] + noise], dim=1)
    return out.contiguous(memory_format=torch.channels_last), context + 0.03 * draw[:, 1:]


def vary_colours(
    colours: Float[Tensor, "n 3 side side"], generator: torch.Generator
) -> Float[Tensor, "n 3 side side"]:
    """Vary the appearance, so that the network relies on shape more than on colour.

    Gamma, gain and tint for every crop; a shading gradient, grey or a uniform colour for some; permuted
    channels for some batches.
    """
    n, _, side, _ = colours.shape
    draw = torch.rand(n, 12, generator=generator).to(colours.device)
    odds = draw[:, :, None, None, None]  # (n, 12, 1, 1, 1)
    image = ((colours + 0.9) / 2).clamp(1e-3, 1)  # back to 0..1
    image = image ** (0.5 + odds[:, 0]) * ((0.5 + 1.1 * odds[:, 1]) * (0.85 + 0.3 * draw[:, 2:5, None, None]))
    across = torch.linspace(-0.5, 0.5, side, device=colours.device)
    slope = (2 * draw[:, 5:7, None, None] - 1) * (odds[:, 7] < 0.4)
    image = image * (1 + slope[:, :1] * across[:, None] + slope[:, 1:] * across)
    image = torch.where(odds[:, 8] < 0.15, image.mean(1, keepdim=True), image)
    image = torch.where(odds[:, 9] < 0.05, odds[:, 10], image)
    if torch.rand(1, generator=generator) < 0.3:
        image = image[:, torch.randperm(3, generator=generator)]
    return 2 * image.clamp(0, 1) - 0.9


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
    """Return cross-entropy and accuracy; for yaw the median error of the most probable bin, in radians."""
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    metrics = {"validation_loss": float(functional.cross_entropy(logits, targets))}
    best, true = logits.argmax(1), targets.argmax(1)
    if task == "class":
        return metrics | {"accuracy": float((best == true).double().mean())}
    error = ((best - true + YAW_BINS // 2) % YAW_BINS - YAW_BINS // 2).abs() * (2 * math.pi / YAW_BINS)
    return metrics | {"yaw_median": float(error.median())}


def calibrated_temperature(network: CropNetwork, crops: CropSet) -> float:
    """Return the temperature of least cross-entropy on held-out crops, by grid search over 0.3 to 3.

    Temperature scaling: Guo et al., "On calibration of modern neural networks", ICML 2017.
    """
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    grid = np.geomspace(0.3, 3.0, 60)
    losses = [float(functional.cross_entropy(logits / t, targets)) for t in grid]
    return float(grid[int(np.argmin(losses))])


def save_checkpoint(path: Path, state: TrainingState[Any], done: int) -> None:
    """Write the state after ``done`` epochs or steps atomically, for ``resume_checkpoint``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        "config": state.config,
        "done": done,
        "network": state.network.state_dict(),
        "optimizer": state.optimizer.state_dict(),
        "schedule": state.schedule.state_dict(),
        "generator": state.generator.get_state(),
    }
    partial = path.with_suffix(".partial")
    torch.save(content, partial)
    partial.replace(path)


def resume_checkpoint(path: Path, state: TrainingState[Any]) -> int:
    """Restore the state from a checkpoint in place and return the epochs or steps done; 0 without one.

    Raises:
        PerceptionError: The checkpoint belongs to another configuration.
    """
    if not path.is_file():
        return 0
    device = next(state.network.parameters()).device
    content = torch.load(path, weights_only=True, map_location=device)
    if content["config"] != state.config:
        raise PerceptionError(
            f"checkpoint {path} is of another configuration; use another --out or remove it"
        )
    state.network.load_state_dict(content["network"])
    state.optimizer.load_state_dict(content["optimizer"])
    state.schedule.load_state_dict(content["schedule"])
    state.generator.set_state(content["generator"].cpu())
    return int(content["done"])
