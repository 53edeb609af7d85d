"""Training of the shape prior: Adam with a cosine schedule, one checkpoint an epoch, resumable to the bit.

Everything random in an epoch comes from (seed, epoch), so that a run interrupted and resumed equals one that
was not. The loop knows nothing of where shapes come from or who watches: it takes datasets and a callback.
"""

from __future__ import annotations

import json
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch

from perception.errors import InvalidInputError, PerceptionError
from perception.shape.dataset import ShapeDataset, occupancies
from perception.shape.losses import LossConfig, shape_loss, voxel_weights
from perception.shape.network import ShapeVae, channels_last, class_one_hot
from perception.types import CODE_SIZE

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShapeTrainingConfig:
    """How to train.

    Attributes:
        epochs: passes over the data; the learning rate falls to zero over them.
        batch_size: shapes in a step.
        learning_rate: of Adam, at the top of the schedule.
        warmup_steps: steps of linear rise at the start.
        loss: weights of the loss terms.
        seed: of the initial weights, the order of the shapes, mirroring and the latent noise.
    """

    epochs: int = 18
    batch_size: int = 16
    learning_rate: float = 2e-3
    warmup_steps: int = 200
    loss: LossConfig = field(default_factory=LossConfig)
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch_size, self.learning_rate) <= 0:
            raise InvalidInputError("epochs, batch size and learning rate must be positive")


@dataclass(frozen=True)
class EpochRecord:
    """What one epoch came to.

    Attributes:
        epoch: 1 for the first.
        loss: mean training loss in [nat] a shape.
        divergence: mean KL divergence in [nat] a shape.
        seconds: wall time of the epoch in [s].
    """

    epoch: int
    loss: float
    divergence: float
    seconds: float


OnEpoch = Callable[[EpochRecord, ShapeVae], None]
OnBatch = Callable[[int, int, int], None]  # epoch, batches done, batches in an epoch


def train(
    data: ShapeDataset,
    config: ShapeTrainingConfig,
    device: str = "cpu",
    checkpoint: Path | None = None,
    on_epoch: OnEpoch | None = None,
    on_batch: OnBatch | None = None,
) -> ShapeVae:
    """Train a new network, or go on from the checkpoint where there is one.

    The checkpoint is written after every epoch; an interruption (KeyboardInterrupt passes through) loses at
    most the epoch it fell into.
    """
    if not len(data):
        raise InvalidInputError("there are no shapes to train on")
    model = ShapeVae().initialise(torch.Generator().manual_seed(config.seed))
    channels_last(model, device)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    done = 0
    if checkpoint is not None and checkpoint.exists():
        done = load_checkpoint(checkpoint, config, model, optimizer)
        log.info("going on from %s after epoch %d", checkpoint, done)
    for epoch in range(done, config.epochs):
        record = train_epoch(model, optimizer, data, config, epoch, device, on_batch)
        if checkpoint is not None:
            save_checkpoint(checkpoint, config, model, optimizer, epoch + 1)
        if on_epoch is not None:
            on_epoch(record, model)
    return model


def train_epoch(
    model: ShapeVae,
    optimizer: torch.optim.Optimizer,
    data: ShapeDataset,
    config: ShapeTrainingConfig,
    epoch: int,
    device: str,
    on_batch: OnBatch | None = None,
) -> EpochRecord:
    """One pass over the data."""
    started = time.monotonic()
    rng = np.random.default_rng([config.seed, epoch])
    noise_generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n_batches = math.ceil(len(data) / config.batch_size)
    losses, divergences = [], []
    model.train()
    for index, (grids, categories) in enumerate(data.batches(config.batch_size, rng)):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, epoch * n_batches + index, config.epochs * n_batches)
        noise = torch.randn(len(grids), CODE_SIZE, generator=noise_generator).to(device)
        targets = torch.from_numpy(occupancies(grids)).to(device)
        weights = torch.from_numpy(voxel_weights(grids, categories, config.loss)).to(device)
        one_hot = class_one_hot(torch.from_numpy(categories)).to(device)
        logits, mean, log_variance = model(targets, one_hot, noise)
        loss, divergence = shape_loss(logits, targets, weights, mean, log_variance, config.loss.beta)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
        divergences.append(divergence)
        if on_batch is not None:
            on_batch(epoch + 1, index + 1, n_batches)
    mean_loss, mean_divergence = (float(torch.stack(values).mean()) for values in (losses, divergences))
    if not math.isfinite(mean_loss):
        raise PerceptionError(f"training diverged in epoch {epoch + 1}; lower the learning rate")
    return EpochRecord(epoch + 1, mean_loss, mean_divergence, time.monotonic() - started)


def learning_rate(config: ShapeTrainingConfig, step: int, n_steps: int) -> float:
    """Linear rise, then half a cosine to zero."""
    rise = min(1.0, (step + 1) / max(1, config.warmup_steps))
    return config.learning_rate * rise * 0.5 * (1.0 + math.cos(math.pi * step / n_steps))


def save_checkpoint(
    path: Path,
    config: ShapeTrainingConfig,
    model: ShapeVae,
    optimizer: torch.optim.Optimizer,
    epochs_done: int,
) -> None:
    """Write weights, optimiser state and configuration; a killed process leaves the previous checkpoint."""
    state = {
        "config": json.dumps(asdict(config)),
        "epochs_done": epochs_done,
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    torch.save(state, temporary)
    os.replace(temporary, path)


def load_checkpoint(
    path: Path, config: ShapeTrainingConfig, model: ShapeVae, optimizer: torch.optim.Optimizer
) -> int:
    """Restore what ``save_checkpoint`` wrote and return the number of epochs done."""
    remedy = "delete it to start anew, or choose another output folder"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        saved_config, epochs_done = state["config"], int(state["epochs_done"])
        if saved_config == json.dumps(asdict(config)):
            model.load_state_dict(state["model"])
            optimizer.load_state_dict(state["optimizer"])
    except Exception as error:  # torch raises many kinds for a file that is not one of its own
        kind = type(error).__name__
        raise PerceptionError(f"checkpoint {path} cannot be read ({kind}); {remedy}") from error
    if saved_config != json.dumps(asdict(config)):
        raise PerceptionError(
            f"checkpoint {path} belongs to another configuration ({saved_config}); {remedy}"
        )
    return epochs_done
