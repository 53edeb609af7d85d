"""Training of the shape prior: Adam with warm-up and cosine decay, exactly resumable checkpoints.

All random numbers of an epoch derive from (seed, epoch), so a resumed run equals an uninterrupted one bit
by bit.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from perception.distributed import Ranks
from perception.errors import InvalidInputError, PerceptionError
from perception.io.weights import write_checkpoint
from perception.shape.dataset import ShapeDataset, occupancies
from perception.shape.losses import LossConfig, shape_loss, voxel_weights
from perception.shape.network import ShapeVae, channels_last, class_one_hot
from perception.types import CODE_SIZE

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShapeTrainingConfig:
    """Hyperparameters of the training.

    Attributes:
        epochs: Number of passes over the data, over which the learning rate decays to zero.
        batch_size: Number of shapes in a step.
        learning_rate: Peak learning rate of Adam.
        warmup_steps: Number of steps of linear warm-up.
        loss: Weights of the loss terms.
        seed: Seed of the initial weights, the order of the shapes, the mirroring and the latent noise.
    """

    epochs: int = 16
    batch_size: int = 16
    learning_rate: float = 2e-3
    warmup_steps: int = 200
    loss: LossConfig = LossConfig()
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch_size, self.learning_rate) <= 0:
            raise InvalidInputError("epochs, batch size and learning rate must be positive")


@dataclass(frozen=True)
class EpochRecord:
    """Statistics of one epoch.

    Attributes:
        epoch: Number of the epoch, from 1.
        loss: Mean training loss of a shape in [nat].
        divergence: Mean KL divergence of a shape in [nat].
        seconds: Wall time in [s].
    """

    epoch: int
    loss: float
    divergence: float
    seconds: float


OnEpoch = Callable[[EpochRecord, ShapeVae], None]
OnBatch = Callable[[int, int, int], None]  # epoch from 1, batches done, batches per epoch


@dataclass(frozen=True)
class TrainingRun:
    """State of a training; model and optimizer are updated in place.

    Attributes:
        config: Hyperparameters.
        model: Network on ``device``.
        optimizer: Optimiser of the model's parameters.
        device: "cpu" or "cuda".
        ranks: Processes that share each batch.
        network: The model, or parallel around it.
    """

    config: ShapeTrainingConfig
    model: ShapeVae
    optimizer: torch.optim.Optimizer
    device: str
    ranks: Ranks
    network: torch.nn.Module

    @staticmethod
    def start(config: ShapeTrainingConfig, device: str, ranks: Ranks = Ranks()) -> TrainingRun:
        """Initialise network and optimiser from the seed."""
        model = ShapeVae().initialise(torch.Generator().manual_seed(config.seed))
        channels_last(model, device)
        optimizer = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
        return TrainingRun(config, model, optimizer, device, ranks, ranks.parallel(model))


def train(
    data: ShapeDataset,
    config: ShapeTrainingConfig,
    device: str = "cpu",
    checkpoint: Path | None = None,
    on_epoch: OnEpoch | None = None,
    on_batch: OnBatch | None = None,
    ranks: Ranks = Ranks(),
) -> ShapeVae:
    """Train a new network, or resume from the checkpoint if the file exists.

    The checkpoint is written after every epoch; an interruption (KeyboardInterrupt propagates) loses at
    most the current epoch.

    Args:
        data: Training shapes.
        config: Hyperparameters.
        device: "cpu" or "cuda".
        checkpoint: File of the checkpoint; None writes none.
        on_epoch: Called with the statistics and the network after every epoch; twice for an epoch if the
            process ends before its checkpoint is written.
        on_batch: Called after every batch.
        ranks: Processes that share each batch; the first calls ``on_epoch`` and writes the checkpoint.

    Raises:
        InvalidInputError: ``data`` is empty.
        PerceptionError: The checkpoint is unusable, or training diverged.
    """
    if not len(data):
        raise InvalidInputError("there are no shapes to train on")
    run = TrainingRun.start(config, device, ranks)
    done = 0
    if checkpoint is not None and checkpoint.exists():
        done = load_checkpoint(checkpoint, run)
        logger.info("resuming from %s after epoch %d", checkpoint, done)
    for epoch in range(done, config.epochs):
        record = train_epoch(run, data, epoch, on_batch)
        if not ranks.is_first:
            continue
        if on_epoch is not None:
            on_epoch(record, run.model)
        if checkpoint is not None:  # last: an epoch whose results were not stored is repeated
            save_checkpoint(checkpoint, run, epoch + 1)
    return run.model


def train_epoch(
    run: TrainingRun, data: ShapeDataset, epoch: int, on_batch: OnBatch | None = None
) -> EpochRecord:
    """Train for one pass over the data; ``epoch`` counts from 0."""
    started = time.monotonic()
    config, optimizer, device, ranks = run.config, run.optimizer, run.device, run.ranks
    rng = np.random.default_rng([config.seed, epoch])
    noise_generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    n_batches = math.ceil(len(data) / config.batch_size)
    losses, divergences = [], []
    run.network.train()
    for index, (grids, categories) in enumerate(data.batches(config.batch_size, rng)):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, epoch * n_batches + index, config.epochs * n_batches)
        noise = torch.randn(len(grids), CODE_SIZE, generator=noise_generator)
        whole, share = len(grids), ranks.share(len(grids))
        grids, categories, noise = grids[share], categories[share], noise[share].to(device)
        targets = torch.from_numpy(occupancies(grids)).to(device)
        weights = torch.from_numpy(voxel_weights(grids, categories, config.loss)).to(device)
        one_hot = class_one_hot(torch.from_numpy(categories)).to(device)
        logits, mean, log_variance = run.network(targets, one_hot, noise)
        loss, divergence = shape_loss(logits, targets, weights, mean, log_variance, config.loss.beta)
        loss, divergence = (ranks.weighted(value, len(grids), whole) for value in (loss, divergence))
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
        divergences.append(divergence)
        if on_batch is not None:
            on_batch(epoch + 1, index + 1, n_batches)
    mean_loss, mean_divergence = (
        float(ranks.total(torch.stack(values).mean())) / ranks.count for values in (losses, divergences)
    )
    if not math.isfinite(mean_loss):
        raise PerceptionError(f"training diverged in epoch {epoch + 1}; lower the learning rate")
    return EpochRecord(epoch + 1, mean_loss, mean_divergence, time.monotonic() - started)


def learning_rate(config: ShapeTrainingConfig, step: int, n_steps: int) -> float:
    """Return the learning rate of a step, from 0: linear warm-up times cosine decay to zero."""
    warmup = min(1.0, (step + 1) / max(1, config.warmup_steps))
    return config.learning_rate * warmup * 0.5 * (1.0 + math.cos(math.pi * step / n_steps))


def save_checkpoint(path: Path, run: TrainingRun, epochs_done: int) -> None:
    """Write weights, optimiser state and configuration atomically."""
    state = {
        "config": json.dumps(asdict(run.config)),
        "epochs_done": epochs_done,
        "model": run.model.state_dict(),
        "optimizer": run.optimizer.state_dict(),
    }
    write_checkpoint(path, state)


def load_checkpoint(path: Path, run: TrainingRun) -> int:
    """Restore model and optimiser of the run and return the number of completed epochs.

    Raises:
        PerceptionError: The file is unreadable or of another configuration.
    """
    config = json.dumps(asdict(run.config))
    remedy = "delete it to start again, or choose another output folder"
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        saved_config, epochs_done = state["config"], int(state["epochs_done"])
        if saved_config == config:
            run.model.load_state_dict(state["model"])
            run.optimizer.load_state_dict(state["optimizer"])
    except Exception as error:  # torch raises various types for malformed files
        kind = type(error).__name__
        raise PerceptionError(f"checkpoint {path} cannot be read ({kind}); {remedy}") from error
    if saved_config != config:
        raise PerceptionError(
            f"checkpoint {path} belongs to another configuration ({saved_config}); {remedy}"
        )
    return epochs_done
