"""Rendered data sets on disk: small images for the scene network, and crops for the class and yaw networks.

Scenes are rendered at 640 x 480; crops are taken at this resolution, images are stored at that of the scene
network. Every file (shard) holds a few hundred images; existing shards are reused, so that an interrupted run
can be resumed.
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
    label_crops,
    perturb_masks,
    perturb_plane,
)
from app.training.files import load_arrays, save_arrays
from perception.detection.scene_training import LabelledScene
from perception.detection.working_view import downscale
from perception.types import CATEGORIES, OTHER, CameraIntrinsics, RgbdFrame

if TYPE_CHECKING:
    from sim_assets.datasets.table_top import LabelledImage

logger = logging.getLogger(__name__)

SHARD = 250  # images per file
PICTURES_PER_POOL = 84  # images before the shapes are redrawn: more shapes help more than more views
MAX_THINGS = 20  # objects and distractors per image
_DEPTH_STEP = 1e-4  # [m]
_SIZE = (640, 480)


@dataclass(frozen=True)
class CropScenes:
    """A distribution of crowded scenes for crops.

    Attributes:
        name: Prefix of the files.
        shares: Proportions of the objects of CATEGORIES.
        pictures_per_pool: Number of images before the shapes are redrawn.
        astray: Share of the masks with a part of a neighbour, and of those with a missing part.
        drawn_in: Share of the flat and lidded cans with a narrower foot.
        stream: Key of its random stream.
    """

    name: str
    shares: tuple[int, int, int, int]
    pictures_per_pool: int
    astray: float
    drawn_in: float
    stream: int


MIXED = CropScenes("close_ups", (4, 1, 2, 2), PICTURES_PER_POOL, 0.25, 0.0, 1)
UPRIGHT = CropScenes("upright_close_ups", (1, 1, 4, 4), 28, 0.4, 0.6, 2)  # many shapes of bottles and cans


@dataclass(frozen=True)
class LabelledScenes:
    """n images with ground truth at the scene network's resolution, each of at most k objects.

    Attributes:
        rgb: (n, h, w, 3).
        depth: (n, h, w) depth in 0.1 mm, 0 where it is missing.
        things: (n, h, w) 1 + index of the object or distractor at each pixel, 0 for background.
        label: (n, k) class of each object, OTHER for distractors.
        foot: (n, k, 2) footprint: where each object's axis meets the table (z = 0), in metres.
        camera: (n, 4) fx, fy, cx, cy in pixels.
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
        """Return the RGB-D frame of an image."""
        depth = self.depth[index].astype(np.float32) * np.float32(_DEPTH_STEP)
        camera = CameraIntrinsics(depth.shape[1], depth.shape[0], *(float(v) for v in self.camera[index]))
        return RgbdFrame(0.0, self.rgb[index], depth, camera, self.pose[index])

    def labelled(self, index: int) -> LabelledScene:
        """Return an image with its ground truth."""
        return LabelledScene(self.frame(index), self.things[index], self.label[index], self.foot[index])

    def save(self, path: Path) -> None:
        """Write the arrays to an npz file, atomically."""
        save_arrays(path, self, _COLUMNS)

    @staticmethod
    def load(path: Path) -> LabelledScenes:
        """Read what ``save`` wrote; raises PerceptionError for a damaged file."""
        return LabelledScenes(**load_arrays(path, _COLUMNS, "scenes"))

    @staticmethod
    def concatenate(parts: Sequence[LabelledScenes]) -> LabelledScenes:
        """Concatenate at least one part."""
        return LabelledScenes(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in _COLUMNS})


_COLUMNS = ("rgb", "depth", "things", "label", "foot", "camera", "pose")


def render_scene_shards(
    directory: Path, split: Split, pictures: int, seed: int, progress: Progress | None = None
) -> list[Path]:
    """Render random scenes and return their files, for ``load_scenes``; existing files are reused."""

    def render(path: Path, count: int, shard: int) -> None:
        _render_scenes(split, count, np.random.SeedSequence([seed, shard])).save(path)

    return _shards(directory, f"{split}_seed{seed}", pictures, render, f"{split} scenes", progress)


def render_crop_shards(
    directory: Path,
    split: Split,
    pictures: int,
    seed: int,
    progress: Progress | None = None,
    kind: CropScenes = MIXED,
) -> list[Path]:
    """Render crops from crowded scenes and return their files, for ``load_crops``; existing files are reused.

    Difficult cases are more frequent: mugs, bottles similar to cans, distractors made of random parts
        (training
    split only), and masks with a part of a neighbour or a missing part.
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
    """Return one file per SHARD images, rendering those that do not exist."""
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
    split: Split, count: int, kind: CropScenes, seed: np.random.SeedSequence
) -> LabelledCrops:
    from sim_assets.datasets.table_top import TrainingSceneConfig
    from sim_assets.datasets.training_scenes import TrainingScenes

    rng = np.random.default_rng(seed.spawn(1)[0])
    config = TrainingSceneConfig(
        width=_SIZE[0], height=_SIZE[1], pool=36, distractors=16, shares=kind.shares, random_parts=0.4,
        plain_tumblers=False, drawn_in=kind.drawn_in, objects=(6, 14), extras=(1, 5),
        pictures_per_pool=kind.pictures_per_pool, distance=(0.28, 0.95),
        elevation=(np.radians(25), np.radians(90)), noises=(0.05, 0.1, 0.35, 0.25, 0.25),
    )  # fmt: skip
    crops = []
    with TrainingScenes(split, int(seed.generate_state(1)[0]), config) as scenes:
        for image in scenes.render(count):
            masks = perturb_masks(image, rng, astray=kind.astray)
            crops.append(label_crops(image, perturb_plane(rng), masks))
    logger.info("%d close-ups: %d crops", count, sum(map(len, crops)))
    return LabelledCrops.concatenate(crops)


def load_scenes(paths: Sequence[Path]) -> LabelledScenes:
    """Load and concatenate shards of images."""
    return LabelledScenes.concatenate([LabelledScenes.load(path) for path in paths])


def load_crops(paths: Sequence[Path]) -> LabelledCrops:
    """Load and concatenate shards of crops."""
    return LabelledCrops.concatenate([LabelledCrops.load(path) for path in paths])


def _render_scenes(split: Split, count: int, seed: np.random.SeedSequence) -> LabelledScenes:
    from sim_assets.datasets.table_top import TrainingSceneConfig
    from sim_assets.datasets.training_scenes import TrainingScenes

    config = TrainingSceneConfig(
        width=_SIZE[0], height=_SIZE[1], pool=32, distractors=16, pictures_per_pool=PICTURES_PER_POOL,
        distance=(0.28, 0.95), elevation=(np.radians(25), np.radians(90)),
    )  # fmt: skip
    with TrainingScenes(split, int(seed.generate_state(1)[0]), config) as scenes:
        return LabelledScenes.concatenate([downscale_image(image) for image in scenes.render(count)])


def downscale_image(image: LabelledImage) -> LabelledScenes:
    """Return one image at the scene network's resolution.

    A pixel belongs to an object where at least two of its four quarters do.
    """
    frame = downscale(image.frame)
    k = frame.intrinsics
    factor = image.instances.shape[1] // k.width
    quarters = np.stack([(image.instances + 1)[i::factor, j::factor] for i in (0, 1) for j in (0, 1)])
    things = np.sort(quarters, axis=0)[2]  # the second largest: two of four
    label, foot = np.full(MAX_THINGS, OTHER, np.uint8), np.zeros((MAX_THINGS, 2), np.float32)
    for index, thing in enumerate(image.labels):
        label[index] = OTHER if thing.category is None else CATEGORIES.index(thing.category)
        foot[index] = thing.T_world_object[:2, 3]
    columns = (
        frame.rgb, np.round(frame.depth / _DEPTH_STEP).clip(0, 65535).astype(np.uint16),
        things.astype(np.uint8), label, foot, np.array([k.fx, k.fy, k.cx, k.cy]), frame.T_world_camera,
    )  # fmt: skip
    return LabelledScenes(*(np.asarray(column)[None] for column in columns))
