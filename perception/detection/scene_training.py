"""Training of the scene network: foreground, classes and votes together, from pictures whose truth is known.

Where pictures come from is not decided here. The last checkpoint holds everything needed to go on after an
interruption.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from perception.detection.scene_network import CLASSES, VOTE_UNIT, SceneNet
from perception.detection.training import Progress, resume, save_checkpoint, schedule_at
from perception.detection.working_view import WorkingView, working_view
from perception.types import RgbdFrame, SupportPlane

logger = logging.getLogger(__name__)
_SAVE_EVERY = 120.0  # [s] between checkpoints
_CENTIMETRE = 0.01
_LOSSES = ("foreground", "class", "vote")


@dataclass(frozen=True)
class Picture:
    """One picture with its truth, at the network's resolution; the table is the plane z = 0.

    Attributes:
        frame: as ``working_view.reduced`` leaves it.
        things: (h, w) 1 + index of the thing each pixel shows, 0 for none.
        label: (k,) class of each thing.
        foot: (k, 2) where its axis meets the table in [m].
    """

    frame: RgbdFrame
    things: UInt8[np.ndarray, "h w"]
    label: UInt8[np.ndarray, "k"]
    foot: Float[np.ndarray, "k 2"]


@dataclass(frozen=True)
class SceneTrainingConfig:
    """How the scene network is trained.

    Attributes:
        epochs: passes over the pictures, each time a random part of ``side`` pixels.
        batch: pictures per step.
        side: of the part, a multiple of 32.
        learning_rate, warmup, weight_decay: of AdamW and its cosine schedule.
        foreground_weight, class_weight, vote_weight: of the three losses.
        other: weight of the votes of things of no class: nobody needs their feet exactly.
        seed: of initialisation, order and augmentation.
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
class Sample:
    """A part of a picture as the network takes it, and what it should answer.

    Attributes:
        channels: (side, side, 8).
        things: (side, side) of each pixel.
        label: (side / 2, side / 2) class of every other pixel, -1 for none.
        offset: (side / 2, side / 2, 2) to the thing's foot in pixels.
        pixel: (side / 2, side / 2) size of a pixel in [m].
        weight: (side / 2, side / 2) so that small things count too; 0 for none.
    """

    channels: Float[np.ndarray, "s s 8"]
    things: UInt8[np.ndarray, "s s"]
    label: np.ndarray
    offset: np.ndarray
    pixel: np.ndarray
    weight: np.ndarray


def train_scene_network(
    pictures: Callable[[int], Picture],
    count: int,
    config: SceneTrainingConfig,
    directory: Path,
    device: str | torch.device = "cpu",
    progress: Progress | None = None,
) -> SceneNet:
    """Train, resuming from ``directory/checkpoint_scene.pt`` if an earlier run left one.

    Args:
        pictures: gives the picture of a number below ``count``.
        progress: called now and then with (step, steps, figures).

    Raises:
        PerceptionError: the checkpoint there belongs to another configuration.
    """
    generator = torch.Generator().manual_seed(config.seed)  # of the order; its state is in the checkpoint
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        network = SceneNet().to(device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(
        network.parameters(), config.learning_rate, weight_decay=config.weight_decay
    )
    per_epoch = max(1, count // config.batch)
    steps = config.epochs * per_epoch
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda s: schedule_at(s / steps, config.warmup))
    parts = (network, optimizer, schedule, generator)
    checkpoint = directory / "checkpoint_scene.pt"
    done = resume(checkpoint, config, *parts)
    network.train()
    saved, running = time.monotonic(), np.zeros(3)
    for step, rows in _batches(count, per_epoch, config, done):
        rng = np.random.default_rng((config.seed, step))
        losses = _step(network, [sampled(pictures(int(i)), config, rng) for i in rows], config)
        optimizer.zero_grad(set_to_none=True)
        losses.sum().backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimizer.step()
        schedule.step()
        running = 0.98 * running + 0.02 * losses.detach().cpu().numpy()
        if time.monotonic() - saved > _SAVE_EVERY or step + 1 == steps:
            save_checkpoint(checkpoint, config, step + 1, *parts)
            saved = time.monotonic()
        if (step + 1) % 50 == 0:
            bias = 1 - 0.98 ** (step + 1 - done)
            figures: dict[str, float] = dict(zip(_LOSSES, (running / bias).tolist()))
            logger.info("scene step %d of %d: %s", step + 1, steps, figures)
            if progress:
                progress(step + 1, steps, figures)
    return network.eval()


def _batches(
    count: int, per_epoch: int, config: SceneTrainingConfig, done: int
) -> Iterator[tuple[int, np.ndarray]]:
    """(number, rows) of the steps that are left; the order depends on the seed alone."""
    for epoch in range(done // per_epoch, config.epochs):
        order = np.random.default_rng((config.seed, 1, epoch)).permutation(count)
        for k in range(done % per_epoch if epoch == done // per_epoch else 0, per_epoch):
            yield epoch * per_epoch + k, order[k * config.batch : (k + 1) * config.batch]


def sampled(picture: Picture, config: SceneTrainingConfig, rng: np.random.Generator) -> Sample:
    """A random part of a picture, perhaps mirrored, its colours and its depth disturbed."""
    part = tuple(_window(length, config.side, rng) for length in picture.things.shape)
    things = picture.things[part]
    view = working_view(_with_holes(_part_of(picture.frame, part), things, rng), _shaken(rng))
    things, channels, pixel = np.rot90(things, view.turns), view.channels, view.pixel
    offset = _offsets(view, things, picture.foot)
    if rng.random() < 0.5:
        channels, things, pixel = channels[:, ::-1], things[:, ::-1], pixel[:, ::-1]
        offset = offset[:, ::-1] * np.array([-1, 1], np.float32)
    channels = np.dstack([recoloured(channels[..., :3], rng), channels[..., 3:]])
    coarse = things[::2, ::2]
    label = np.where(coarse > 0, picture.label[np.maximum(coarse, 1) - 1].astype(np.int64), -1)
    sizes = np.bincount(coarse.ravel(), minlength=256).astype(np.float32)
    weight = np.where(coarse > 0, 1 / np.sqrt(np.maximum(sizes[coarse], 20)), 0).astype(np.float32)
    return Sample(
        np.ascontiguousarray(channels), np.ascontiguousarray(things), label, offset[::2, ::2],
        pixel[::2, ::2], weight,
    )  # fmt: skip


def _part_of(frame: RgbdFrame, part: tuple[slice, ...]) -> RgbdFrame:
    """What a camera with a smaller sensor would have seen."""
    k, (rows, columns) = frame.intrinsics, part
    height, width = frame.depth[part].shape
    camera = replace(k, width=width, height=height, cx=k.cx - columns.start, cy=k.cy - rows.start)
    return RgbdFrame(frame.time, frame.rgb[part], frame.depth[part], camera, frame.T_world_camera)


def _window(length: int, side: int, rng: np.random.Generator) -> slice:
    start = 2 * int(rng.integers(0, (length - side) // 2 + 1)) if length > side else 0
    return slice(start, start + side)


def _offsets(
    view: WorkingView, things: np.ndarray, foot: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "h w 2"]:
    """From each pixel's place to the foot of what it shows, in pixels; nonsense where it shows nothing."""
    places = (foot @ view.axes[:, :2].T).astype(np.float32)
    target = places[np.maximum(things.astype(int), 1) - 1] - view.plan
    return np.clip(target / view.pixel[..., None], -500, 500)


def _shaken(rng: np.random.Generator) -> SupportPlane:
    """The table as a fit would find it."""
    normal = np.array([*rng.normal(0, np.radians(0.25), 2), 1.0])
    return SupportPlane(normal / np.linalg.norm(normal), float(rng.normal(0, 0.0012)))


def _with_holes(frame: RgbdFrame, things: np.ndarray, rng: np.random.Generator) -> RgbdFrame:
    """Patches without depth, as shiny, black or clear surfaces leave them."""
    if rng.random() < 0.5:
        return frame
    depth = frame.depth.copy()
    shape = depth.shape
    holes = np.zeros(shape, np.uint8)
    v, u = np.nonzero(things)
    for _ in range(rng.integers(1, 6)):
        on_thing = len(v) > 0 and rng.random() < 0.8
        k = rng.integers(len(v)) if on_thing else 0
        centre = (
            (int(u[k]), int(v[k])) if on_thing else (int(rng.integers(shape[1])), int(rng.integers(shape[0])))
        )
        axes = (int(rng.integers(2, 16)), int(rng.integers(2, 16)))
        cv2.ellipse(holes, centre, axes, rng.uniform(0, 180), 0, 360, 1, -1)
    patchy = cv2.resize(rng.random((shape[0] // 3 + 1, shape[1] // 3 + 1)), shape[::-1])
    depth[(holes > 0) & (patchy < rng.uniform(0.3, 1.0))] = 0
    return replace(frame, depth=depth)


def recoloured(rgb: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    """Colours (about 0, within one half) of another camera in another light: colour is only a hint."""
    image = rgb + 0.5
    if rng.random() < 0.3:
        image = image[..., rng.permutation(3)]
    if rng.random() < 0.1:
        image = np.repeat(image.mean(-1, keepdims=True), 3, axis=-1)
    image = np.power(np.clip(image, 0, 1), rng.uniform(0.5, 1.5), dtype=np.float32)
    image = image * rng.uniform(0.6, 1.8) * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    if rng.random() < 0.4:  # another shading across the picture
        height, width = image.shape[:2]
        corners = rng.uniform(0.6, 1.4, (2, 2)).astype(np.float32)
        image = image * cv2.resize(corners, (width, height))[..., None]
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), rng.uniform(0.4, 1.2))
    noise = rng.standard_normal(image.shape, dtype=np.float32) * (rng.uniform(0, 0.05) * (rng.random() < 0.5))
    return (np.clip(image + rng.uniform(-0.1, 0.1) + noise, 0, 1) - 0.5).astype(np.float32)


def _step(network: SceneNet, samples: list[Sample], config: SceneTrainingConfig) -> Float[Tensor, "3"]:
    """Weighted losses of foreground, classes and votes."""
    device = next(network.parameters()).device

    def stacked(name: str) -> Tensor:
        return torch.from_numpy(np.stack([getattr(sample, name) for sample in samples])).to(device)

    answer = network(stacked("channels").permute(0, 3, 1, 2))
    return losses_of(
        answer, stacked("things"), stacked("label"), stacked("offset"), stacked("pixel"), stacked("weight"),
        config,
    )  # fmt: skip


def losses_of(
    answer: Float[Tensor, "n 12 h w"],
    things: Tensor,
    label: Tensor,
    offset: Tensor,
    pixel: Tensor,
    weight: Tensor,
    config: SceneTrainingConfig,
) -> Float[Tensor, "3"]:
    """Binary cross-entropy of the foreground; cross-entropy of classes; negative log-likelihood of votes.

    Errors of votes [cm] follow exp(-r / b) / b^2 with the spread b that the network expects.
    """
    foreground = functional.pixel_unshuffle((things > 0).float()[:, None], 2)
    loss_foreground = functional.binary_cross_entropy_with_logits(answer[:, :4], foreground)
    weight = weight / weight.sum().clamp(min=1e-6)
    logits = answer[:, 4 : 4 + CLASSES]
    by_pixel = functional.cross_entropy(
        logits, label, ignore_index=-1, reduction="none", label_smoothing=0.02
    )
    loss_class = (weight * by_pixel).sum()
    vote, spread = answer[:, 4 + CLASSES : 6 + CLASSES], answer[:, 6 + CLASSES]
    error = (vote.permute(0, 2, 3, 1) * VOTE_UNIT - offset) * (pixel / _CENTIMETRE)[..., None]
    distance = torch.sqrt((error**2).sum(-1) + 1e-4)
    spread = spread.clamp(-4, 4)
    likelihood = distance * torch.exp(-spread) + 2 * spread
    loss_vote = (weight * torch.where(label == CLASSES - 1, config.other, 1.0) * likelihood).sum()
    weights = (config.foreground_weight, config.class_weight, config.vote_weight)
    return torch.stack([
        w * loss for w, loss in zip(weights, (loss_foreground, loss_class, loss_vote), strict=True)
    ])  # fmt: skip
