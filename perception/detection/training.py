"""Training of the crop networks: classes by cross-entropy, yaw by cross-entropy with soft bins.

Pure tensors in, weights out: where crops come from is not decided here (``app.training.crop_dataset`` makes
them from renders). The last checkpoint holds everything needed to go on after an interruption.
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
from torch import Tensor
from torch.nn import functional

from perception.detection.network import (
    OUTPUTS,
    CropNet,
    CropNetwork,
    Task,
    logits_both_ways,
    mirrored_bins,
    prepared,
)
from perception.detection.yaw import YAW_BINS
from perception.errors import InvalidInputError, PerceptionError

logger = logging.getLogger(__name__)
Progress = Callable[[int, int, dict[str, float]], None]


@dataclass(frozen=True)
class CropSet:
    """Labelled crops.

    Attributes:
        images: (n, SIDE, SIDE, 6) uint8 as in ``crops.Crop``.
        context: (n, 2) float32 as in ``crops.Crop``.
        targets: (n, k) float32 rows that sum to one: one-hot classes, or soft yaw bins.
    """

    images: UInt8[np.ndarray, "n side side 6"]
    context: Float[np.ndarray, "n 2"]
    targets: Float[np.ndarray, "n k"]

    def __len__(self) -> int:
        return len(self.images)

    def subset(self, rows: Int[np.ndarray, "m"]) -> CropSet:
        return CropSet(self.images[rows], self.context[rows], self.targets[rows])


@dataclass(frozen=True)
class TrainingConfig:
    """How a crop network is trained.

    Attributes:
        epochs: passes over the crops.
        batch: crops per step.
        learning_rate: peak of the cosine schedule, after ``warmup`` (a share of all steps).
        weight_decay: of AdamW.
        label_smoothing: share of the target spread evenly, for the class network.
        seed: of initialisation, order and augmentation.
    """

    epochs: int = 5
    batch: int = 128
    learning_rate: float = 2e-3
    warmup: float = 0.05
    weight_decay: float = 1e-2
    label_smoothing: float = 0.02
    seed: int = 0


def train_crop_network(
    task: Task,
    training: CropSet,
    validation: CropSet,
    config: TrainingConfig,
    directory: Path,
    device: str | torch.device = "cpu",
    progress: Progress | None = None,
) -> CropNet:
    """Train a network, resuming from ``directory/checkpoint_<task>.pt`` if an earlier run left one.

    Args:
        progress: called after every epoch with (epoch, epochs, figures).

    Returns:
        The network in evaluation mode.

    Raises:
        InvalidInputError: a set is empty or its targets have the wrong width.
        PerceptionError: the checkpoint there belongs to another configuration.
    """
    for name, crops in (("training", training), ("validation", validation)):
        if not len(crops) or crops.targets.shape[1] != OUTPUTS[task]:
            raise InvalidInputError(f"{name} crops for '{task}' must be (n > 0, {OUTPUTS[task]}) targets")
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = CropNet(OUTPUTS[task])
    network = network.to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay
    )
    steps = config.epochs * math.ceil(len(training) / config.batch)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: schedule_at(step / steps, config.warmup)
    )
    checkpoint = directory / f"checkpoint_{task}.pt"
    start = resume(checkpoint, config, network, optimizer, schedule, generator)

    for epoch in range(start, config.epochs):
        loss = _one_epoch(task, network, training, config, optimizer, schedule, generator)
        figures = {"loss": loss, **validation_figures(task, network, validation)}
        save_checkpoint(checkpoint, config, epoch + 1, network, optimizer, schedule, generator)
        logger.info("%s epoch %d: %s", task, epoch + 1, figures)
        if progress:
            progress(epoch + 1, config.epochs, figures)
    return network.eval()


def schedule_at(done: float, warmup: float) -> float:
    """Learning rate as a share of its peak: linear warm-up, then a cosine to one hundredth."""
    if done < warmup:
        return (done + 1e-3) / (warmup + 1e-3)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(1.0, (done - warmup) / (1 - warmup))))


def _one_epoch(
    task: Task,
    network: CropNet,
    crops: CropSet,
    config: TrainingConfig,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    generator: torch.Generator,
) -> float:
    network.train()
    device = next(network.parameters()).device
    order = torch.randperm(len(crops), generator=generator).numpy()
    total = 0.0
    for rows in np.array_split(order, max(1, round(len(order) / config.batch))):
        batch = crops.subset(np.sort(rows))
        images = torch.from_numpy(batch.images).to(device)
        context, targets = (torch.from_numpy(a).to(device) for a in (batch.context, batch.targets))
        images, targets = mirrored(task, images, targets, generator)
        inputs = warped(prepared(cut(images, generator)), generator)
        inputs, context = disturbed(inputs, context, generator)
        if task == "class":
            targets = (1 - config.label_smoothing) * targets + config.label_smoothing / targets.shape[1]
        loss = functional.cross_entropy(network(inputs, context), targets)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        total += loss.item() * len(rows)
    return total / len(order)


def mirrored(
    task: Task, images: Tensor, targets: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Half of the crops flipped left to right; their yaw, counted from the view's heading, changes sign."""
    flip = torch.rand(len(images), generator=generator).to(images.device) < 0.5
    images = torch.where(flip[:, None, None, None], images.flip(2), images)
    if task == "yaw":
        targets = torch.where(flip[:, None], mirrored_bins(targets), targets)
    return images, targets


def cut(images: UInt8[Tensor, "n side side 6"], generator: torch.Generator) -> UInt8[Tensor, "n side side 6"]:
    """Three crops of ten lose a band along one side, as the image's border cuts them."""
    n, side = images.shape[:2]
    draw = torch.rand(n, 4, generator=generator).to(images.device)
    ramp = torch.arange(side, device=images.device)
    ramp = torch.where((draw[:, 1] < 0.5)[:, None], ramp, side - 1 - ramp)  # counted from either end
    kept = (ramp >= (0.4 * side * draw[:, 0])[:, None]) | (draw[:, 3] > 0.3)[:, None]  # (n, side)
    along_rows = (draw[:, 2] < 0.5)[:, None, None]
    return images * torch.where(along_rows, kept[:, :, None], kept[:, None, :])[..., None]


def warped(
    inputs: Float[Tensor, "n 6 side side"], generator: torch.Generator, most: float = 0.05
) -> Float[Tensor, "n 6 side side"]:
    """Other shapes: wider here and narrower there by up to ``most``, higher or lower, leaning.

    Objects never trained on differ from those that were in just such ways. A mask's box is never exact, so
    crops move, too, by up to 2.5 times as much of half their side.
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


def disturbed(
    inputs: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"], generator: torch.Generator
) -> tuple[Float[Tensor, "n 6 side side"], Float[Tensor, "n 2"]]:
    """Other colours (``recoloured``), noise on heights and depths, sizes and elevations a little off."""
    n, _, side, _ = inputs.shape
    draw = torch.rand(n, 3, generator=generator).to(inputs.device) * 2 - 1  # uniform in -1..1
    noise = torch.randn(n, 1, side, side, generator=generator).to(inputs.device)
    noise = noise * (0.03 * draw[:, :1].abs())[..., None, None]  # of 0.1 m; farther is lower
    colours = recoloured(inputs[:, :3], generator)
    out = torch.cat([colours, inputs[:, 3:4], inputs[:, 4:5] - noise, inputs[:, 5:6] + noise], dim=1)
    return out.contiguous(memory_format=torch.channels_last), context + 0.03 * draw[:, 1:]


def recoloured(
    colours: Float[Tensor, "n 3 side side"], generator: torch.Generator
) -> Float[Tensor, "n 3 side side"]:
    """Prepared colours in another light, another camera, another paint: colour is only a hint.

    Gamma, gain and tint for every crop; for some a shading across it, no hue, or no picture at all.
    """
    n, _, side, _ = colours.shape
    draw = torch.rand(n, 12, generator=generator).to(colours.device)
    odds = draw[:, :, None, None, None]  # (n, 12, 1, 1, 1)
    image = ((colours + 0.9) / 2).clamp(1e-3, 1)  # 0..1, as the camera gives it
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
        images = prepared(torch.from_numpy(crops.images[start : start + batch]).to(device))
        context = torch.from_numpy(crops.context[start : start + batch]).to(device)
        rows.append(logits_both_ways(network, images, context).float().cpu())
    return torch.cat(rows)


def validation_figures(task: Task, network: CropNetwork, crops: CropSet) -> dict[str, float]:
    """Cross-entropy and accuracy; for yaw the median distance of the best bin from the true one [rad]."""
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    figures = {"validation_loss": float(functional.cross_entropy(logits, targets))}
    best, true = logits.argmax(1), targets.argmax(1)
    if task == "class":
        return figures | {"accuracy": float((best == true).double().mean())}
    apart = ((best - true + YAW_BINS // 2) % YAW_BINS - YAW_BINS // 2).abs() * (2 * math.pi / YAW_BINS)
    return figures | {"yaw_median": float(apart.median())}


def calibrated_temperature(network: CropNetwork, crops: CropSet) -> float:
    """Temperature of least cross-entropy on held-out crops, by search over 0.3 .. 3."""
    logits, targets = _logits(network, crops), torch.from_numpy(crops.targets)
    grid = np.geomspace(0.3, 3.0, 60)
    losses = [float(functional.cross_entropy(logits / t, targets)) for t in grid]
    return float(grid[int(np.argmin(losses))])


def save_checkpoint(
    path: Path,
    config: object,
    done: int,
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    generator: torch.Generator,
) -> None:
    """Everything that ``resume`` needs, written whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {
        "config": repr(config),
        "done": done,
        "network": network.state_dict(),
        "optimizer": optimizer.state_dict(),
        "schedule": schedule.state_dict(),
        "generator": generator.get_state(),
    }
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    partial.replace(path)


def resume(
    path: Path,
    config: object,
    network: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    generator: torch.Generator,
) -> int:
    """How much is already done according to the checkpoint, whose state the arguments take on; 0 without one.

    Raises:
        PerceptionError: the checkpoint belongs to another configuration.
    """
    if not path.is_file():
        return 0
    device = next(network.parameters()).device
    state = torch.load(path, weights_only=True, map_location=device)
    if state["config"] != repr(config):
        raise PerceptionError(
            f"checkpoint {path} is of another configuration; use another --out or remove it"
        )
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    schedule.load_state_dict(state["schedule"])
    generator.set_state(state["generator"].cpu())
    return int(state["done"])
