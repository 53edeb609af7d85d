"""Training of the scene network: joint loss of foreground, classes and votes on images with ground truth.

The images are given by a function (``app.training.scene_dataset`` renders them). The last checkpoint contains
the complete state, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn import functional

from perception.detection.crop_training import TrainingJob, learning_rate_share
from perception.detection.scene_network import CLASSES, VOTE_UNIT, SceneNet
from perception.detection.training_state import TrainingState, resume_checkpoint, save_checkpoint
from perception.detection.working_view import WorkingView, working_view
from perception.types import OTHER, RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)
_SAVE_EVERY = 120.0  # [s] between checkpoints
_CENTIMETRE = 0.01
_LOSSES = ("foreground", "class", "vote")
UNJUDGED = 255  # in ``things``: pixels that may be foreground or background


@dataclass(frozen=True)
class LabelledScene:
    """One image with ground truth at the network's resolution.

    Attributes:
        frame: Result of ``working_view.downscale``.
        things: (h, w) 1 + index of the object or distractor at each pixel, 0 for background, UNJUDGED where
            both are right: furniture around the table is refused by its place.
        label: (k,) class of each object, OTHER for distractors, -1 if it is not to be learned.
        foot: (k, 3) footprint of each object: where its axis meets the table, in metres.
        plane: The table's plane.
    """

    frame: RgbdFrame
    things: UInt8[np.ndarray, "h w"]
    label: Int[np.ndarray, "k"]
    foot: Float[np.ndarray, "k 3"]
    plane: SupportPlane


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
class TrainingPatch:
    """A square patch of an image: network input and targets.

    Attributes:
        channels: (side, side, 8) input channels (``WorkingView.channels``).
        things: (side, side) 1 + index of the object or distractor at each pixel, 0 for background, UNJUDGED
            where both are right.
        label: (side/2, side/2) class of every second pixel, -1 for background.
        offset: (side/2, side/2, 2) offset to the footprint in units of the pixel's size.
        pixel: (side/2, side/2) size of a pixel, in metres.
        weight: (side/2, side/2) weight in the losses, larger for small objects, 0 for background.
    """

    channels: Float[np.ndarray, "s s 8"]
    things: UInt8[np.ndarray, "s s"]
    label: np.ndarray
    offset: np.ndarray
    pixel: np.ndarray
    weight: np.ndarray


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
    network, checkpoint = state.network, job.directory / "checkpoint_scene.pt"
    done = resume_checkpoint(checkpoint, state)
    network.train()
    saved, running = time.monotonic(), np.zeros(3)

    def sample(step: int, rows: np.ndarray) -> list[TrainingPatch]:
        rng = np.random.default_rng((config.seed, step))
        return [sample_patch(scenes(int(i)), config, rng) for i in rows]

    for step, patches in _one_ahead(sample, _batches(count, per_epoch, config, done)):
        losses = _step(network, patches, config)
        state.optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        state.optimizer.step()
        state.schedule.step()
        running = 0.98 * running + 0.02 * losses.detach().cpu().numpy()
        if time.monotonic() - saved > _SAVE_EVERY or step + 1 == steps:
            save_checkpoint(checkpoint, state, step + 1)
            saved = time.monotonic()
        if (step + 1) % 50 == 0:
            bias = 1 - 0.98 ** (step + 1 - done)
            metrics: dict[str, float] = dict(zip(_LOSSES, (running / bias).tolist()))
            logger.info("scene step %d of %d: %s", step + 1, steps, metrics)
            if job.progress:
                job.progress(step + 1, steps, metrics)
    return network.eval()


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


def sample_patch(
    scene: LabelledScene, config: SceneTrainingConfig, rng: np.random.Generator
) -> TrainingPatch:
    """Return a random patch of an image: possibly mirrored, with varied colours, plane and missing depth."""
    part = tuple(_window(length, config.side, rng) for length in scene.things.shape)
    things = scene.things[part]
    items = np.where(things == UNJUDGED, 0, things)
    view = working_view(
        _with_holes(_part_of(scene.frame, part), items, rng), _perturb_plane(scene.plane, rng)
    )
    things, channels, pixel = np.rot90(things, view.turns), view.channels, view.pixel
    offset = _offsets(view, np.rot90(items, view.turns), scene.foot)
    if rng.random() < 0.5:
        channels, things, pixel = channels[:, ::-1], things[:, ::-1], pixel[:, ::-1]
        offset = offset[:, ::-1] * np.array([-1, 1], np.float32)
    channels = np.dstack([vary_colours(channels[..., :3], rng), channels[..., 3:]])
    coarse = np.where(things == UNJUDGED, 0, things)[::2, ::2]
    label = np.where(coarse > 0, scene.label[np.maximum(coarse, 1) - 1].astype(np.int64), -1)
    sizes = np.bincount(coarse.ravel(), minlength=256).astype(np.float32)
    weight = np.where(coarse > 0, 1 / np.sqrt(np.maximum(sizes[coarse], 20)), 0).astype(np.float32)
    return TrainingPatch(
        np.ascontiguousarray(channels), np.ascontiguousarray(things), label, offset[::2, ::2],
        pixel[::2, ::2], weight,
    )  # fmt: skip


def _part_of(frame: RgbdFrame, part: tuple[slice, ...]) -> RgbdFrame:
    """Return the cropped image with the principal point shifted accordingly."""
    k, (rows, columns) = frame.intrinsics, part
    height, width = frame.depth[part].shape
    camera = replace(k, width=width, height=height, cx=k.cx - columns.start, cy=k.cy - rows.start)
    return RgbdFrame(frame.time, frame.rgb[part], frame.depth[part], camera, frame.T_world_camera)


def _window(length: int, side: int, rng: np.random.Generator) -> slice:
    start = 2 * int(rng.integers(0, (length - side) // 2 + 1)) if length > side else 0
    return slice(start, start + side)


def _offsets(
    view: WorkingView, things: np.ndarray, foot: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "h w 2"]:
    """Return the offset from each pixel to its object's footprint, in pixels; undefined for background."""
    footprints = (foot @ view.axes.T).astype(np.float32)
    target = footprints[np.maximum(things.astype(int), 1) - 1] - view.plan
    return np.clip(target / view.pixel[..., None], -500, 500)


def _perturb_plane(plane: SupportPlane, rng: np.random.Generator) -> SupportPlane:
    """Return the table's plane with the error of a fit."""
    normal = plane.normal + np.append(rng.normal(0, np.radians(0.3), 2), 0.0)
    return SupportPlane(normal / np.linalg.norm(normal), float(plane.offset + rng.normal(0, 0.0015)))


def _with_holes(frame: RgbdFrame, things: np.ndarray, rng: np.random.Generator) -> RgbdFrame:
    """Remove depth in patches, as on specular, dark or transparent surfaces."""
    if rng.random() < 0.5:
        return frame
    depth = frame.depth.copy()
    shape = depth.shape
    holes = np.zeros(shape, np.uint8)
    v, u = np.nonzero(things)
    for _ in range(rng.integers(1, 6)):
        on_object = len(v) > 0 and rng.random() < 0.8
        k = rng.integers(len(v)) if on_object else 0
        centre = (
            (int(u[k]), int(v[k]))
            if on_object
            else (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        )
        axes = (int(rng.integers(2, 16)), int(rng.integers(2, 16)))
        cv2.ellipse(holes, centre, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    patchy = cv2.resize(rng.random((shape[0] // 3 + 1, shape[1] // 3 + 1)), shape[::-1])
    depth[(holes > 0) & (patchy < rng.uniform(0.3, 1.0))] = 0
    return replace(frame, depth=depth)


def vary_colours(rgb: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """Vary colours (in -0.5..0.5), so that the network relies on shape more than on colour."""
    image = rgb + 0.5
    if rng.random() < 0.1:
        image = image[..., rng.permutation(3)]
    if rng.random() < 0.1:
        image = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    image = np.power(np.clip(image, 0, 1), rng.uniform(0.5, 1.5), dtype=np.float32)
    image = image * rng.uniform(0.6, 1.8) * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.4:  # a shading gradient
        height, width = image.shape[:2]
        corners = rng.uniform(0.6, 1.4, (2, 2)).astype(np.float32)
        image = image * cv2.resize(corners, (width, height))[..., None]
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(0.4, 1.2))
    noise = rng.standard_normal(image.shape, dtype=np.float32) * (rng.uniform(0, 0.05) * (rng.random() < 0.5))
    return (np.clip(image + rng.uniform(-0.1, 0.1) + noise, 0, 1) - 0.5).astype(np.float32)


def _step(network: SceneNet, patches: list[TrainingPatch], config: SceneTrainingConfig) -> Float[Tensor, "3"]:
    """Return the weighted losses of foreground, classes and votes of a batch."""
    device = next(network.parameters()).device
    columns = {
        field.name: torch.from_numpy(np.stack([getattr(patch, field.name) for patch in patches])).to(device)
        for field in fields(TrainingPatch)
    }
    with torch.autocast(device.type, torch.bfloat16):
        outputs = network(columns.pop("channels").permute(0, 3, 1, 2))
    return scene_losses(outputs.float(), SceneTargets(**columns), config)


def scene_losses(
    outputs: Float[Tensor, "n 12 h w"], targets: SceneTargets, config: SceneTrainingConfig
) -> Float[Tensor, "3"]:
    """Return the weighted losses (foreground, classes, votes).

    Binary cross-entropy of the foreground; cross-entropy of the classes; negative log-likelihood of the vote
    error r in centimetres under exp(-r / b) / b^2 with the predicted standard error b.
    """
    things = functional.pixel_unshuffle(targets.things[:, None].float(), 2)
    judged = (things != UNJUDGED).float()
    by_quarter = functional.binary_cross_entropy_with_logits(
        outputs[:, :4], (things > 0).float(), reduction="none"
    )
    loss_foreground = (judged * by_quarter).mean()
    weight = targets.weight / targets.weight.sum().clamp(min=1e-6)
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
