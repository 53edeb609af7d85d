"""Rendered scenes on disk: small pictures for the scene network, and crops for the class and yaw networks.

Scenes are rendered at 640 x 480, where crops are cut; pictures are kept at the scene network's resolution. A
shard of a few hundred is one file; shards already there are taken as they are, so that an interrupted run
goes on where it stopped.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from app.training.crop_dataset import (
    LabelledCrops,
    Progress,
    Split,
    disturbed_masks,
    jittered_plane,
    labelled_crops,
)
from app.training.files import load_arrays, save_arrays
from perception.detection.network import OTHER
from perception.detection.scene_training import Picture
from perception.detection.working_view import reduced
from perception.types import CATEGORIES, CameraIntrinsics, RgbdFrame

if TYPE_CHECKING:
    from sim_assets.datasets.table_top import LabelledImage

logger = logging.getLogger(__name__)

SHARD = 250  # pictures per file
PICTURES_PER_POOL = 84  # before other shapes take over: variety of shapes helps more than of views
MAX_THINGS = 20
_DEPTH_STEP = 1e-4  # [m]
_SIZE = (640, 480)


@dataclass(frozen=True)
class CloseUps:
    """A kind of crowded scenes that crops are taken from.

    Attributes:
        name: of its files.
        shares: how many objects are of each of CATEGORIES, in proportion.
        pictures_per_pool: how often other shapes take over.
        astray: share of the masks that take in a piece of a neighbour, and of those that lose one of theirs.
        drawn_in: share of the flat and lidded cans that stand on a narrower foot.
        stream: of random numbers.
    """

    name: str
    shares: tuple[int, int, int, int]
    pictures_per_pool: int
    astray: float
    drawn_in: float
    stream: int


MIXED = CloseUps("close_ups", (4, 1, 2, 2), PICTURES_PER_POOL, 0.25, 0.0, 1)
UPRIGHT = CloseUps("upright_close_ups", (1, 1, 4, 4), 28, 0.4, 0.6, 2)  # many shapes of bottles and cans


@dataclass(frozen=True)
class Pictures:
    """Small pictures with their truth; n of them, k things at most in each.

    Attributes:
        rgb: (n, h, w, 3).
        depth: (n, h, w) in 0.1 mm, 0 where nothing was measured.
        things: (n, h, w) 1 + index of the thing that each pixel shows, 0 for none.
        label: (n, k) class of each thing, 4 for things of no class.
        foot: (n, k, 2) where each thing's axis meets the table, which is z = 0, in [m].
        camera: (n, 4) focal lengths and principal point in pixels.
        pose: (n, 4, 4) T_world_camera.
    """

    rgb: UInt8[np.ndarray, "n h w 3"]
    depth: UInt16[np.ndarray, "n h w"]
    things: UInt8[np.ndarray, "n h w"]
    label: UInt8[np.ndarray, "n k"]
    foot: Float[np.ndarray, "n k 2"]
    camera: Float[np.ndarray, "n 4"]
    pose: Float[np.ndarray, "n 4 4"]

    def __len__(self) -> int:
        return len(self.rgb)

    def frame(self, index: int) -> RgbdFrame:
        """A picture as a camera would give it."""
        depth = self.depth[index].astype(np.float32) * np.float32(_DEPTH_STEP)
        camera = CameraIntrinsics(depth.shape[1], depth.shape[0], *(float(v) for v in self.camera[index]))
        return RgbdFrame(0.0, self.rgb[index], depth, camera, self.pose[index])

    def labelled(self, index: int) -> Picture:
        """A picture with its truth."""
        return Picture(self.frame(index), self.things[index], self.label[index], self.foot[index])

    def save(self, path: Path) -> None:
        save_arrays(path, self, _COLUMNS)

    @staticmethod
    def load(path: Path) -> Pictures:
        return Pictures(**load_arrays(path, _COLUMNS, "pictures"))

    @staticmethod
    def joined(parts: Sequence[Pictures]) -> Pictures:
        return Pictures(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in _COLUMNS})


_COLUMNS = ("rgb", "depth", "things", "label", "foot", "camera", "pose")


def rendered_shards(
    directory: Path, split: Split, pictures: int, seed: int, progress: Progress | None = None
) -> list[Path]:
    """Files of random scenes (``shard_pictures``), rendered where they do not exist."""

    def render(path: Path, count: int, shard: int) -> None:
        _render_pictures(split, count, np.random.SeedSequence([seed, shard])).save(path)

    return _shards(directory, f"{split}_seed{seed}", pictures, render, f"{split} scenes", progress)


def close_up_shards(
    directory: Path,
    split: Split,
    pictures: int,
    seed: int,
    progress: Progress | None = None,
    kind: CloseUps = MIXED,
) -> list[Path]:
    """Files of crops (``shard_crops``) from further, crowded scenes.

    More of them show what is hard to tell: mugs by their handles, bottles from cans, in training odd things
    that are neither; some masks take in a piece of a neighbour or lose one of their own.
    """

    def render(path: Path, count: int, shard: int) -> None:
        _render_close_ups(split, count, kind, np.random.SeedSequence([seed, shard, kind.stream])).save(path)

    name = f"{kind.name}_{split}_seed{seed}"
    return _shards(directory, name, pictures, render, kind.name.replace("_", "-"), progress)


def _shards(
    directory: Path,
    name: str,
    pictures: int,
    render: Callable[[Path, int, int], None],
    what: str,
    progress: Progress | None,
) -> list[Path]:
    """A file for every SHARD pictures; those that do not exist are rendered."""
    paths = []
    shards = max(1, math.ceil(pictures / SHARD))
    for shard in range(shards):
        count = min(SHARD, pictures - shard * SHARD)
        path = directory / f"{name}_n{count}_{shard:03d}.npz"
        if not path.is_file():
            if progress:
                progress(f"rendering {what}", shard / shards)
            render(path, count, shard)
        paths.append(path)
    return paths


def _render_close_ups(
    split: Split, count: int, kind: CloseUps, seed: np.random.SeedSequence
) -> LabelledCrops:
    from sim_assets.datasets.table_top import TrainingSceneConfig
    from sim_assets.datasets.training_scenes import TrainingScenes

    rng = np.random.default_rng(seed.spawn(1)[0])
    config = TrainingSceneConfig(
        width=_SIZE[0], height=_SIZE[1], pool=36, distractors=16, shares=kind.shares, odd=0.4,
        plain_tumblers=False, drawn_in=kind.drawn_in, objects=(6, 14), extras=(1, 5),
        pictures_per_pool=kind.pictures_per_pool, distance=(0.28, 0.95),
        elevation=(np.radians(25), np.radians(90)), noises=(0.1, 0.1, 0.8),
    )  # fmt: skip
    crops = []
    with TrainingScenes(split, int(seed.generate_state(1)[0]), config) as scenes:
        for image in scenes.render(count):
            masks = disturbed_masks(image, rng, astray=kind.astray)
            crops.append(labelled_crops(image, jittered_plane(rng), masks))
    logger.info("%d close-ups: %d crops", count, sum(map(len, crops)))
    return LabelledCrops.joined(crops)


def shard_pictures(paths: Sequence[Path]) -> Pictures:
    return Pictures.joined([Pictures.load(path) for path in paths])


def shard_crops(paths: Sequence[Path]) -> LabelledCrops:
    return LabelledCrops.joined([LabelledCrops.load(path) for path in paths])


def _render_pictures(split: Split, count: int, seed: np.random.SeedSequence) -> Pictures:
    from sim_assets.datasets.table_top import TrainingSceneConfig
    from sim_assets.datasets.training_scenes import TrainingScenes

    config = TrainingSceneConfig(
        width=_SIZE[0], height=_SIZE[1], pool=32, distractors=16, pictures_per_pool=PICTURES_PER_POOL,
        distance=(0.28, 0.95), elevation=(np.radians(25), np.radians(90)),
    )  # fmt: skip
    with TrainingScenes(split, int(seed.generate_state(1)[0]), config) as scenes:
        return Pictures.joined([small_picture(image) for image in scenes.render(count)])


def small_picture(image: LabelledImage) -> Pictures:
    """One picture at the scene network's resolution. A pixel shows a thing where half of its area does."""
    frame = reduced(image.frame)
    k = frame.intrinsics
    factor = image.instances.shape[1] // k.width
    quarters = np.stack([(image.instances + 1)[i::factor, j::factor] for i in (0, 1) for j in (0, 1)])
    things = np.sort(quarters, axis=0)[2]  # 0 is the table: half of the four suffice
    label, foot = np.full(MAX_THINGS, OTHER, np.uint8), np.zeros((MAX_THINGS, 2), np.float32)
    for index, thing in enumerate(image.labels):
        label[index] = OTHER if thing.category is None else CATEGORIES.index(thing.category)
        foot[index] = thing.T_world_object[:2, 3]
    columns = (
        frame.rgb, np.round(frame.depth / _DEPTH_STEP).clip(0, 65535).astype(np.uint16),
        things.astype(np.uint8), label, foot, np.array([k.fx, k.fy, k.cx, k.cy]), frame.T_world_camera,
    )  # fmt: skip
    return Pictures(*(np.asarray(column)[None] for column in columns))
