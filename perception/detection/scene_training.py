"""Training of the scene network: joint loss of foreground, classes and votes on patches of images.

The images are given by a function (``app.training.scene_dataset`` renders them). The last checkpoint contains
the complete state, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from perception.detection.crop_training import TrainingJob, learning_rate_share
from perception.detection.scene_network import SceneNet
from perception.detection.scene_patches import UNJUDGED, LabelledScene, TrainingPatch, sample_patch
from perception.detection.tasks import CLASSES, VOTE_UNIT
from perception.detection.training_state import (
    TrainingState,
    mixed_precision,
    resume_checkpoint,
    save_checkpoint,
)
from perception.distributed import Ranks
from perception.types import OTHER

logger = logging.getLogger(__name__)
_SAVE_EVERY = 120.0  # [s] between checkpoints
_CENTIMETRE = 0.01
_LOSSES = ("foreground", "class", "vote")


@dataclass(frozen=True)
class SceneTrainingConfig:
    """Hyperparameters of the scene network.

    Attributes:
        epochs: Number of passes over the images, each with a random patch of every image.
        batch: Number of patches per step.
        side: Side of the square patches in pixels, a multiple of 32.
        learning_rate: Peak of the cosine schedule of AdamW.
        warmup: Share of the steps with linear warm-up.
        weight_decay: Weight decay of AdamW.
        foreground_weight: Weight of the foreground loss.
        class_weight: Weight of the class loss.
        vote_weight: Weight of the vote loss.
        other: Relative weight of distractors in the vote loss: their footprints need not be exact.
        seed: Seed of initialisation, order and augmentation.
    """

    epochs: int = 12
    batch: int = 8
    side: int = 192
    learning_rate: float = 2e-3
    warmup: float = 0.03
    weight_decay: float = 1e-2
    foreground_weight: float = 2.0
    class_weight: float = 0.5
    vote_weight: float = 0.15
    other: float = 0.3
    seed: int = 0


@dataclass(frozen=True)
class SceneTargets:
    """A batch of ``TrainingPatch`` without its channels, as tensors with a leading batch axis."""

    things: Tensor
    label: Tensor
    offset: Tensor
    pixel: Tensor
    weight: Tensor


def train_scene_network(
    scenes: Callable[[int], LabelledScene], count: int, config: SceneTrainingConfig, job: TrainingJob
) -> SceneNet:
    """Train the scene network, resuming from ``checkpoint_scene.pt`` in the job's folder if it exists.

    Args:
        scenes: Returns the image of an index below ``count``.
        count: Number of images.
        config: Hyperparameters.
        job: Folder and device; progress is reported every 50 steps, with smoothed losses.

    Returns:
        The network in evaluation mode.

    Raises:
        PerceptionError: The checkpoint belongs to another configuration.
    """
    per_epoch = max(1, count // config.batch)
    steps = config.epochs * per_epoch
    state = _initial_state(config, steps, job.device)
    checkpoint, ranks = job.directory / "checkpoint_scene.pt", job.ranks
    done = resume_checkpoint(checkpoint, state)
    network = ranks.parallel(state.network)
    network.train()
    saved, running = time.monotonic(), np.zeros(3)

    def sample(step: int, rows: np.ndarray) -> list[TrainingPatch]:
        rng = np.random.default_rng((config.seed, step))
        return [sample_patch(scenes(int(i)), config.side, rng) for i in rows]

    for step, patches in _one_ahead(sample, _batches(count, per_epoch, config, done)):
        losses = _step(network, patches, config, ranks)
        state.optimizer.zero_grad(set_to_none=True)
        (ranks.count * losses.sum()).backward()  # the gradients of the ranks are averaged
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        state.optimizer.step()
        state.schedule.step()
        running = 0.98 * running + 0.02 * ranks.total(losses.detach()).cpu().numpy()
        if not ranks.is_first:
            continue
        if time.monotonic() - saved > _SAVE_EVERY or step + 1 == steps:
            save_checkpoint(checkpoint, state, step + 1)
            saved = time.monotonic()
        if (step + 1) % 50 == 0:
            bias = 1 - 0.98 ** (step + 1 - done)
            metrics: dict[str, float] = dict(zip(_LOSSES, (running / bias).tolist()))
            logger.info("scene step %d of %d: %s", step + 1, steps, metrics)
            if job.progress:
                job.progress(step + 1, steps, metrics)
    return state.network.eval()


def _initial_state(
    config: SceneTrainingConfig, steps: int, device: str | torch.device
) -> TrainingState[SceneNet]:
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = SceneNet().to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimizer, lambda step: learning_rate_share(step / steps, config.warmup)
    )
    return TrainingState(repr(config), network, optimizer, schedule, generator)


def _batches(
    count: int, per_epoch: int, config: SceneTrainingConfig, done: int
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (step, image indices) of the remaining steps; the order depends on the seed only."""
    for epoch in range(done // per_epoch, config.epochs):
        order = np.random.default_rng((config.seed, 1, epoch)).permutation(count)
        for k in range(done % per_epoch if epoch == done // per_epoch else 0, per_epoch):
            yield epoch * per_epoch + k, order[k * config.batch : (k + 1) * config.batch]


def _one_ahead(
    sample: Callable[[int, np.ndarray], list[TrainingPatch]], batches: Iterator[tuple[int, np.ndarray]]
) -> Iterator[tuple[int, list[TrainingPatch]]]:
    """Yield (step, patches) of every batch; a thread samples the next batch meanwhile."""
    with ThreadPoolExecutor(1) as pool:
        waiting = None
        for step, rows in batches:
            following = (step, pool.submit(sample, step, rows))
            if waiting is not None:
                yield waiting[0], waiting[1].result()
            waiting = following
        if waiting is not None:
            yield waiting[0], waiting[1].result()


def _step(
    network: nn.Module, patches: list[TrainingPatch], config: SceneTrainingConfig, ranks: Ranks
) -> Float[Tensor, "3"]:
    """Return the weighted losses of foreground, classes and votes of a batch, or the part of a rank's share.

    The parts of all ranks add up to the losses of the batch.
    """
    device = next(network.parameters()).device
    whole = {
        field.name: torch.from_numpy(np.stack([getattr(patch, field.name) for patch in patches]))
        for field in fields(TrainingPatch)
    }
    share = ranks.share(len(patches))
    columns = {name: column[share].to(device) for name, column in whole.items()}
    channels = columns.pop("channels")
    with mixed_precision(device):
        outputs = network(channels.permute(0, 3, 1, 2)).float()
    if not len(channels):
        return outputs.sum() * outputs.new_zeros(3)
    if ranks.count == 1:
        return scene_losses(outputs, SceneTargets(**columns), config)
    losses = scene_losses(outputs, SceneTargets(**columns), config, whole["weight"].sum().to(device))
    return losses * losses.new_tensor([len(channels) / len(patches), 1, 1])  # the first is a mean


def scene_losses(
    outputs: Float[Tensor, "n 12 h w"],
    targets: SceneTargets,
    config: SceneTrainingConfig,
    whole_weight: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "3"]:
    """Return the weighted losses (foreground, classes, votes).

    Binary cross-entropy of the foreground; cross-entropy of the classes; negative log-likelihood of the vote
    error r in centimetres under exp(-r / b) / b^2 with the predicted standard error b. Weights of classes and
    votes are relative to ``whole_weight``, by default their sum.
    """
    things = functional.pixel_unshuffle(targets.things[:, None].float(), 2)
    judged = (things != UNJUDGED).float()
    by_quarter = functional.binary_cross_entropy_with_logits(
        outputs[:, :4], (things > 0).float(), reduction="none"
    )
    loss_foreground = (judged * by_quarter).mean()
    total = targets.weight.sum() if whole_weight is None else whole_weight
    weight = targets.weight / total.clamp(min=1e-6)
    logits = outputs[:, 4 : 4 + CLASSES]
    by_pixel = functional.cross_entropy(
        logits, targets.label, ignore_index=-1, reduction="none", label_smoothing=0.02
    )
    loss_class = (weight * by_pixel).sum()
    vote, spread = outputs[:, 4 + CLASSES : 6 + CLASSES], outputs[:, 6 + CLASSES]
    error = (vote.permute(0, 2, 3, 1) * VOTE_UNIT - targets.offset) * (targets.pixel / _CENTIMETRE)[..., None]
    distance = torch.sqrt((error**2).sum(-1) + 1e-4)
    spread = spread.clamp(-4, 4)
    likelihood = distance * torch.exp(-spread) + 2 * spread
    class_weight = torch.where(targets.label == OTHER, config.other, 1.0)
    loss_vote = (weight * class_weight * likelihood).sum()
    weights = (config.foreground_weight, config.class_weight, config.vote_weight)
    return torch.stack([
        w * loss for w, loss in zip(weights, (loss_foreground, loss_class, loss_vote), strict=True)
    ])  # fmt: skip
