"""Rendered data sets on disk: small images for the scene network, and crops for the class and yaw networks.

Scenes are rendered at 640 x 480; crops are taken at this resolution, images are stored at that of the scene
network. Every shard holds the images and the crops of some scenes in two files, or the crops alone; existing
shards are reused, so that an interrupted run can be resumed.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from app.jobs import Workers
from app.training.crop_dataset import (
    LabelledCrops,
    Progress,
    Split,
    bodies_of_mugs,
    label_crops,
    perturb_masks,
    perturb_plane,
)
from app.training.files import load_arrays, packed_arrays
from app.training.shards import Contents, write_shards
from perception.detection.scene_patches import UNJUDGED, LabelledScene
from perception.detection.working_view import downscale
from perception.types import CATEGORIES, OTHER, CameraIntrinsics, RgbdFrame, SupportPlane

if TYPE_CHECKING:
    from sim_assets.datasets.labels import LabelledImage
    from sim_assets.datasets.scene_config import TrainingSceneConfig

logger = logging.getLogger(__name__)

SHARD = 100  # images per file
MAX_THINGS = 24  # objects and distractors per image
IGNORED = 255  # label of objects whose class is not to be learned
ASTRAY = 0.3  # share of the masks with a part of a neighbour, and of those with a missing part
MUGS = (9, 1, 1, 1)  # relative numbers of mugs, bowls, bottles and cans where most objects are mugs
_DEPTH_STEP = 1e-4  # [m]
_SIZE = (640, 480)


@dataclass(frozen=True)
class Shard:
    """Scenes that are rendered together.

    Attributes:
        directory: Folder of the two files.
        split: Families of objects and kinds of distractors.
        seed: Seed of the data set.
        number: Number of the shard in the data set.
        count: Number of images.
        crops_only: Whether the images are not kept.
        stacked: Share of the images with objects on or in others.
        mugs: Whether most objects are mugs, which have crops with masks that end at their bodies as well.
    """

    directory: Path
    split: Split
    seed: int
    number: int
    count: int
    crops_only: bool = False
    stacked: float = 0.0
    mugs: bool = False

    @property
    def scenes(self) -> Path:
        """File of the images, for ``load_scenes``."""
        return self._file("scenes")

    @property
    def crops(self) -> Path:
        """File of the crops, for ``load_crops``."""
        return self._file("crops")

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of the shard, in the order of ``render_shard``."""
        return (self.crops,) if self.crops_only else (self.crops, self.scenes)

    def _file(self, what: str) -> Path:
        return self.directory / f"{what}_{self.split}_seed{self.seed}_n{self.count}_{self.number:03d}.npz"


@dataclass(frozen=True)
class LabelledScenes:
    """n images with ground truth at the scene network's resolution, each of at most k objects.

    Attributes:
        rgb: (n, h, w, 3).
        depth: (n, h, w) depth in 0.1 mm, 0 where it is missing.
        things: (n, h, w) 1 + index of the object or distractor at each pixel, 0 for background, UNJUDGED
            for things around the table.
        label: (n, k) class of each object, OTHER for distractors, IGNORED.
        foot: (n, k, 3) footprint: where each object's axis meets the table, as the image shows it, in metres.
        plane: (n, 4) the table's normal and offset as the image shows it.
        camera: (n, 4) fx, fy, cx, cy in pixels.
        pose: (n, 4, 4) T_world_camera.
    """

    rgb: UInt8[np.ndarray, "n h w 3"]
    depth: UInt16[np.ndarray, "n h w"]
    things: UInt8[np.ndarray, "n h w"]
    label: UInt8[np.ndarray, "n k"]
    foot: Float[np.ndarray, "n k 3"]
    plane: Float[np.ndarray, "n 4"]
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
        *normal, offset = self.plane[index]
        label = self.label[index].astype(np.int64)
        return LabelledScene(
            self.frame(index), self.things[index], np.where(label == IGNORED, -1, label), self.foot[index],
            SupportPlane(np.array(normal), float(offset)),
        )  # fmt: skip

    def packed(self) -> bytes:
        """Return the arrays as the content of an npz file."""
        return packed_arrays(self, _COLUMNS)

    @staticmethod
    def load(path: Path) -> LabelledScenes:
        """Read a file of ``packed`` arrays; raises PerceptionError for a damaged file."""
        return LabelledScenes(**load_arrays(path, _COLUMNS, "scenes"))

    @staticmethod
    def concatenate(parts: Sequence[LabelledScenes]) -> LabelledScenes:
        """Concatenate at least one part."""
        return LabelledScenes(**{n: np.concatenate([getattr(part, n) for part in parts]) for n in _COLUMNS})


_COLUMNS = ("rgb", "depth", "things", "label", "foot", "plane", "camera", "pose")


def render_shards(
    directory: Path,
    split: Split,
    pictures: int,
    seed: int,
    workers: Workers = Workers(),
    progress: Progress | None = None,
    *,
    crops_only: bool = False,
    stacked: float = 0.0,
    mugs: bool = False,
) -> list[Shard]:
    """Render random scenes and return their shards; existing ones are reused.

    Args:
        directory: Folder of the shards.
        split: Families of objects and kinds of distractors.
        pictures: Number of images.
        seed: Seed of the data set.
        workers: Where they are rendered.
        progress: Called after every shard.
        crops_only: Whether only crops are kept, which are about a quarter of the data.
        stacked: Share of the images with objects on or in others.
        mugs: Whether most objects are mugs, which have crops with masks that end at their bodies as well.

    Raises:
        PerceptionError: A shard could not be rendered.
    """
    shards = [
        Shard(
            directory, split, seed, number, min(SHARD, pictures - number * SHARD), crops_only, stacked, mugs
        )
        for number in range(max(1, math.ceil(pictures / SHARD)))
    ]
    write_shards(shards, render_shard, workers, f"rendering {split} scenes", progress)
    return shards


def render_shard(shard: Shard) -> Contents:
    """Render the scenes of a shard and return the content of its files."""
    from sim_assets.datasets.training_scenes import TrainingScenes

    seed = np.random.SeedSequence([shard.seed, shard.number, shard.split == "test"])
    rng = np.random.default_rng(seed.spawn(1)[0])
    scenes, crops = [], []
    config = replace(training_scene_config(), stacked=shard.stacked)
    if shard.mugs:
        config = replace(config, shares=MUGS)
    with TrainingScenes(shard.split, int(seed.generate_state(1)[0]), config) as source:
        for image in source.render(shard.count):
            if not shard.crops_only:
                scenes.append(downscale_image(image))
            masks = perturb_masks(image, rng, astray=ASTRAY)
            masks += bodies_of_mugs(image, masks) if shard.mugs else []
            crops.append(label_crops(image, perturb_plane(image.plane, rng), masks))
    packed = LabelledCrops.concatenate(crops).packed()
    return (packed, LabelledScenes.concatenate(scenes).packed()) if scenes else (packed,)


def training_scene_config() -> TrainingSceneConfig:
    """Return the distribution of the training scenes: sizes, rooms, cameras and sensors of other people."""
    from sim_assets.datasets.scene_config import RoomConfig, TrainingSceneConfig

    return TrainingSceneConfig(
        width=_SIZE[0], height=_SIZE[1], pool=48, distractors=26, shares=(5, 2, 4, 5), household=0.7,
        free=0.4, filled=0.12, toppled=0.06, random_parts=0.45, plain_tumblers=False, drawn_in=0.5,
        pictures_per_pool=SHARD // 2, pictures_per_texture=5, textures_redrawn=20, objects=(2, 12),
        extras=(0, 8), spread=(0.14, 0.42), distance=(0.28, 1.4),
        elevation=(np.radians(14), np.radians(88)), fovy=(36.0, 56.0), upturned=0.12,
        noises=(0.07, 0.08, 0.35, 0.30, 0.20), misregistered=0.5, cut=0.35, room=RoomConfig(),
    )  # fmt: skip


def load_scenes(paths: Sequence[Path]) -> LabelledScenes:
    """Load and concatenate shards of images."""
    return LabelledScenes.concatenate([LabelledScenes.load(path) for path in paths])


def load_crops(paths: Sequence[Path]) -> LabelledCrops:
    """Load and concatenate shards of crops."""
    return LabelledCrops.concatenate([LabelledCrops.load(path) for path in paths])


def downscale_image(image: LabelledImage) -> LabelledScenes:
    """Return one image at the scene network's resolution.

    A pixel belongs to an object where at least two of its four quarters do.
    """
    frame = downscale(image.frame)
    k = frame.intrinsics
    factor = image.instances.shape[1] // k.width
    quarters = np.stack([(image.instances + 1)[i::factor, j::factor] for i in (0, 1) for j in (0, 1)])
    things = np.sort(quarters, axis=0)[2]  # the second largest: two of four
    if image.surroundings is not None:
        around = image.surroundings[::factor, ::factor]
        things[(things == 0) & around[: things.shape[0], : things.shape[1]]] = UNJUDGED
    label, foot = np.full(MAX_THINGS, OTHER, np.uint8), np.zeros((MAX_THINGS, 3), np.float32)
    for index, thing in enumerate(image.labels):
        known = OTHER if thing.category is None else CATEGORIES.index(thing.category)
        label[index] = IGNORED if thing.ignored else known
        foot[index] = thing.foot
    columns = (
        frame.rgb, np.round(frame.depth / _DEPTH_STEP).clip(0, 65535).astype(np.uint16),
        things.astype(np.uint8), label, foot, np.array([*image.plane.normal, image.plane.offset]),
        np.array([k.fx, k.fy, k.cx, k.cy]), frame.T_world_camera,
    )  # fmt: skip
    return LabelledScenes(*(np.asarray(column)[None] for column in columns))
