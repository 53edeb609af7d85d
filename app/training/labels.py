"""Labelled crops from renders whose truth is known: what the class and yaw networks learn and are judged on.

Instances come from the detector's own segmentation, not from the true masks, so that the networks meet its
errors: too wide masks, parts, mergers. The truth only names them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from perception.detection.crops import CHANNELS, CONTEXT, SIDE, crop, filtered_geometry
from perception.detection.geometry import heading_angle, points_of
from perception.detection.network import OTHER
from perception.detection.segmentation import segment
from perception.errors import PerceptionError
from perception.types import CATEGORIES, SupportPlane

if TYPE_CHECKING:
    from sim_assets.training_scenes import LabelledImage  # perception alone runs without a simulator

logger = logging.getLogger(__name__)
Progress = Callable[[str, float], None]  # what is going on, and the share of the whole job done
Split = Literal["train", "test"]

PURITY = 0.8  # share of a mask's object pixels that one object holds, for the mask to be named after it
COVERAGE = 0.4  # share of an object's visible pixels that a mask holds, for the mask to be named after it
MIN_PIXELS = 150  # true pixels of an object that count as seen
SHARD = 250  # pictures per file
PICTURES_PER_POOL = 125  # before other shapes take over: variety of shapes helps more than of views


@dataclass(frozen=True)
class SegmentationCounts:
    """How geometry alone did: objects seen, found (IoU over one half), the sum of their IoU, masks made."""

    seen: int = 0
    found: int = 0
    iou_sum: float = 0.0
    masks: int = 0

    def __add__(self, other: SegmentationCounts) -> SegmentationCounts:
        return SegmentationCounts(*(a + b for a, b in zip(astuple(self), astuple(other))))

    @property
    def recall(self) -> float:
        return self.found / max(self.seen, 1)

    @property
    def mean_iou(self) -> float:
        return self.iou_sum / max(self.found, 1)


@dataclass(frozen=True)
class LabelledCrops:
    """Crops with their truth.

    Attributes:
        images, context: as in ``perception.detection.crops.Crop``.
        label: (n,) index into CATEGORIES, or 4 for things of no class.
        yaw: (n,) angle of the object's +x counted from the crop's heading in [rad]; 0 where it means nothing.
        handle: (n,) share of the mask's points that lie on a mug's handle; 0 for everything else.
        iou: (n,) overlap of the mask with the true one.
        counts: how the masks of the whole pictures matched.
    """

    images: UInt8[np.ndarray, "n side side 6"]
    context: Float[np.ndarray, "n 2"]
    label: Int[np.ndarray, "n"]
    yaw: Float[np.ndarray, "n"]
    handle: Float[np.ndarray, "n"]
    iou: Float[np.ndarray, "n"]
    counts: SegmentationCounts = SegmentationCounts()

    def __len__(self) -> int:
        return len(self.label)

    def of(self, rows: Bool[np.ndarray, "n"] | Int[np.ndarray, "m"]) -> LabelledCrops:
        return LabelledCrops(**{name: getattr(self, name)[rows] for name in _COLUMNS}, counts=self.counts)

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        columns = {name: getattr(self, name) for name in _COLUMNS}
        np.savez(partial, counts=np.array(astuple(self.counts)), **columns)
        partial.replace(path)

    @staticmethod
    def load(path: Path) -> LabelledCrops:
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                seen, found, iou_sum, masks = file["counts"].tolist()
                counts = SegmentationCounts(int(seen), int(found), iou_sum, int(masks))
                return LabelledCrops(**{name: file[name] for name in _COLUMNS}, counts=counts)
        except (OSError, KeyError, ValueError, BadZipFile) as error:
            raise PerceptionError(
                f"{path} holds no labelled crops ({error}); delete it and train again"
            ) from error

    @staticmethod
    def joined(parts: Sequence[LabelledCrops]) -> LabelledCrops:
        counts = sum((part.counts for part in parts), SegmentationCounts())
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        return LabelledCrops(**columns, counts=counts)


_COLUMNS = ("images", "context", "label", "yaw", "handle", "iou")


def labelled_crops(image: LabelledImage, plane: SupportPlane) -> LabelledCrops:
    """Crops of one picture; masks that nobody could name are left out."""
    frame, truth = image.frame, image.instances
    geometry = filtered_geometry(frame, plane)
    size = np.bincount(truth[truth >= 0], minlength=len(image.labels))
    best = np.zeros(len(image.labels))
    masks = [mask for mask in segment(frame, plane) if (mask & (geometry[0] > 0)).any()]
    rows = []
    for mask in masks:
        inside = np.bincount(truth[mask & (truth >= 0)], minlength=len(image.labels))
        index = int(inside.argmax()) if inside.sum() else -1
        iou = float(inside[index] / (mask.sum() + size[index] - inside[index])) if index >= 0 else 0.0
        if index >= 0:
            best[index] = max(best[index], iou)
        label = _label_of(image, mask, inside, size)
        if label is None:
            continue
        piece = crop(frame, mask, plane, geometry)
        yaw, handle = 0.0, 0.0
        if label == CATEGORIES.index("mug"):
            thing = image.labels[index]
            yaw = (thing.yaw - heading_angle(piece.heading, plane) + np.pi) % (2 * np.pi) - np.pi
            handle = handle_share(points_of(frame, truth == index, geometry[0]), thing.T_world_object)
        rows.append((piece.image, piece.context, label, yaw, handle, iou))

    seen = np.array([thing.category is not None for thing in image.labels], dtype=bool) & (size >= MIN_PIXELS)
    found = seen & (best > 0.5)
    counts = SegmentationCounts(int(seen.sum()), int(found.sum()), float(best[found].sum()), len(masks))
    columns = zip(_COLUMNS, _DTYPES, zip(*rows) if rows else _NO_ROWS)
    return LabelledCrops(**{name: np.array(c, dtype=t) for name, t, c in columns}, counts=counts)


_DTYPES = (np.uint8, np.float32, np.int64, np.float32, np.float32, np.float32)  # of the columns
_NO_ROWS = (np.zeros((0, SIDE, SIDE, CHANNELS)), np.zeros((0, CONTEXT)), *[np.zeros(0)] * 4)


def _label_of(
    image: LabelledImage,
    mask: Bool[np.ndarray, "h w"],
    inside: Int[np.ndarray, "k"],
    size: Int[np.ndarray, "k"],
) -> int | None:
    """Class index of a mask, 4 for no class, None where nobody could say."""
    if inside.sum() < 0.3 * mask.sum():
        return OTHER  # table, wall or nothing at all
    index = int(inside.argmax())
    category = image.labels[index].category
    if inside[index] < PURITY * inside.sum():
        return None
    if category is None:
        return OTHER
    return CATEGORIES.index(category) if inside[index] >= COVERAGE * size[index] else None


def handle_share(points: Float[np.ndarray, "n 3"], T_world_object: Float[np.ndarray, "4 4"]) -> float:
    """Share of a mug's visible points that lie on its handle.

    The body's radius is that of the points well away from +x; the handle is what lies 5 mm outside it within
    50 degrees of +x.
    """
    if len(points) == 0:
        return 0.0
    local = (points - T_world_object[:3, 3]) @ T_world_object[:3, :3]
    radius, angle = np.hypot(local[:, 0], local[:, 1]), np.abs(np.arctan2(local[:, 1], local[:, 0]))
    body = radius[angle > np.radians(60)]
    if len(body) < 20:
        return 0.0
    return float(((radius > np.percentile(body, 99) + 0.005) & (angle < np.radians(50))).mean())


def cached_crops(
    directory: Path,
    split: Split,
    pictures: int,
    seed: int,
    width: int = 320,
    progress: Progress | None = None,
) -> LabelledCrops:
    """Crops of random scenes, from files where they exist: each shard of pictures is one file.

    Shards already in the directory are taken as they are, so an interrupted run goes on where it stopped.
    """
    parts = []
    shards = max(1, math.ceil(pictures / SHARD))
    for shard in range(shards):
        count = min(SHARD, pictures - shard * SHARD)
        path = directory / f"{split}_seed{seed}_w{width}_n{count}_{shard:03d}.npz"
        if not path.is_file():
            if progress:
                progress(f"rendering {split} scenes", shard / shards)
            _render_shard(split, count, np.random.SeedSequence([seed, shard]), width).save(path)
        parts.append(LabelledCrops.load(path))
    return LabelledCrops.joined(parts)


def _render_shard(split: Split, count: int, seed: np.random.SeedSequence, width: int) -> LabelledCrops:
    from sim_assets.training_scenes import TrainingSceneConfig, TrainingScenes

    rng = np.random.default_rng(seed.spawn(1)[0])
    config = TrainingSceneConfig(
        width=width,
        height=width * 3 // 4,
        pool=32,
        distractors=12,
        pictures_per_pool=PICTURES_PER_POOL,
        distance=(0.30, 0.70),
        elevation=(np.radians(35), np.radians(90)),
    )
    with TrainingScenes(split, int(seed.generate_state(1)[0]), config) as scenes:
        crops = LabelledCrops.joined([
            labelled_crops(image, jittered_plane(rng)) for image in scenes.render(count)
        ])  # fmt: skip
    counts = crops.counts
    message = "%s: %d pictures, %d crops; recall %.3f, IoU %.3f"
    logger.info(message, split, count, len(crops), counts.recall, counts.mean_iou)
    return crops


def jittered_plane(rng: np.random.Generator) -> SupportPlane:
    """The table top as a fit would find it: half a millimetre and a tenth of a degree off."""
    normal = np.array([*rng.normal(0, np.radians(0.1), 2), 1.0])
    return SupportPlane(normal=normal / np.linalg.norm(normal), offset=float(rng.normal(0, 0.0005)))
