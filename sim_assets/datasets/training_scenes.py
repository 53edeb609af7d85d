"""Labelled images of random table tops, the training data of the detector. No arm, no physics.

A pool of objects and distractors is compiled once; for each image some are shown and moved by editing the
model in place, the others are hidden. Textures change every few images, the pool less often. One process
renders at least 20 images a second; run shards in separate processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import trimesh

from perception.types import CATEGORIES, POSED_CLASSES, Category, RestingPose
from sim_assets.datasets.distractors import random_distractor, random_parts, random_surrounding
from sim_assets.datasets.labels import LabelledImage
from sim_assets.datasets.scatter import TableItem, make_item, simplified
from sim_assets.datasets.scene_config import TrainingSceneConfig
from sim_assets.datasets.table_top import TableTop
from sim_assets.objects.bottle import BottleParameters
from sim_assets.objects.can import FOOT, CanParameters
from sim_assets.objects.families import Parameters, make_solid, sample_parameters
from sim_assets.objects.free_forms import free_form
from sim_assets.objects.household import contents_of, sample_household
from sim_assets.rendering.texture_coordinates import ATTRIBUTE, around

Split = Literal["train", "test"]
_HANDLE_ROLL = np.radians(105)  # largest angle of the handle of a lying mug from the vertical
PLAIN_BEND = 0.10  # a tumbler that widens less, relative to its radius, resembles a can


class TrainingScenes:
    """Renders labelled images of objects of one split; the same seed gives the same images."""

    def __init__(
        self,
        split: Split,
        seed: int,
        config: TrainingSceneConfig | None = None,
        own: Sequence[tuple[Category, trimesh.Trimesh]] = (),
    ) -> None:
        """Seed the generator; ``own`` meshes, if given, replace generated objects, not distractors."""
        self._own = [make_item(category, simplified(mesh)) for category, mesh in own]
        self.config = config or TrainingSceneConfig()
        self.split: Split = split
        self._rng = np.random.default_rng(seed)
        self._pool: TableTop | None = None

    def render(self, count: int) -> Iterator[LabelledImage]:
        """Yield the next ``count`` images."""
        config, rng = self.config, self._rng
        for number in range(count):
            if number % config.pictures_per_pool == 0:
                self.close()
                items = _draw_items(self.split, config, rng, self._own)
                around = config.room.pool if config.room is not None else 0
                surroundings = [random_surrounding(rng, self.split) for _ in range(around)]
                self._pool = TableTop(items, config, rng, surroundings)
            assert self._pool is not None
            if number % config.pictures_per_texture == 0:
                self._pool.redraw_textures(rng)
            yield self._pool.picture(rng)

    def close(self) -> None:
        """Free the GL context."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def __enter__(self) -> TrainingScenes:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _draw_items(
    split: Split, config: TrainingSceneConfig, rng: np.random.Generator, own: Sequence[TableItem] = ()
) -> list[TableItem]:
    items = [own[index % len(own)] for index in range(config.pool)] if own else []
    turns: list[Category] = [
        category for category, share in zip(CATEGORIES, config.shares) for _ in range(share)
    ]
    for index in range(0 if own else config.pool):
        items.append(_draw_object(turns[index % len(turns)], split, config, rng))
    for _ in range(config.distractors):
        odd = split == "train" and config.random_parts > 0 and rng.random() < config.random_parts
        items.append(make_item(None, random_parts(rng) if odd else random_distractor(rng, split)))
    return items


def _draw_object(
    category: Category, split: Split, config: TrainingSceneConfig, rng: np.random.Generator
) -> TableItem:
    parameters = _draw_parameters(category, split, config, rng)
    mesh = simplified(make_solid(parameters).mesh())
    if rng.random() < config.toppled:
        return replace(make_item(None, _toppled(mesh, rng)), ignored=True)
    if config.posed > 0 and rng.random() < config.posed:
        resting: RestingPose = rng.choice([p for c, p in POSED_CLASSES if c == category and p != "upright"])
        return replace(
            make_item(category, _resting(mesh, category, resting, rng)), ignored=True, resting=resting
        )
    content = contents_of(parameters, rng) if rng.random() < config.filled else None
    return replace(make_item(category, mesh), content=content)


def _resting(
    mesh: trimesh.Trimesh, category: Category, resting: RestingPose, rng: np.random.Generator
) -> trimesh.Trimesh:
    """Return an upright mesh upside down, or on its side with a mug's handle beside it or above, on z = 0."""
    turn = trimesh.transformations.rotation_matrix
    roll = rng.uniform(-np.pi, np.pi)
    if category == "mug" and resting == "lying":
        roll = np.pi / 2 + rng.uniform(-1, 1) * _HANDLE_ROLL  # the turn about x takes +y up
    mesh = _printed(mesh)
    mesh.apply_transform(turn(roll, (0, 0, 1)))
    mesh.apply_transform(turn(np.pi if resting == "upside-down" else np.pi / 2, (1, 0, 0)))
    mesh.apply_translation((*-mesh.bounds[:, :2].mean(axis=0), -mesh.bounds[0, 2]))
    return mesh


def _toppled(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return an upright mesh lying on its side at a random roll, or upside down, on z = 0."""
    turn = trimesh.transformations.rotation_matrix
    down = np.pi if rng.random() < 0.3 else np.pi / 2
    mesh = _printed(mesh)
    mesh.apply_transform(turn(down, (1, 0, 0)) @ turn(rng.uniform(-np.pi, np.pi), (0, 0, 1)))
    mesh.apply_translation((*-mesh.bounds[:, :2].mean(axis=0), -mesh.bounds[0, 2]))
    return mesh


def _printed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return an upright mesh with its own texture coordinates, so that its print turns with it."""
    mesh = mesh.copy()
    mesh.face_attributes[ATTRIBUTE] = around(mesh).reshape(-1, 3, 2)
    return mesh


def _draw_parameters(
    category: Category, split: Split, config: TrainingSceneConfig, rng: np.random.Generator
) -> Parameters:
    while True:
        sample = sample_household if rng.random() < config.household else sample_parameters
        p = sample(category, split, rng)
        if split == "train" and config.drawn_in > 0 and isinstance(p, CanParameters):
            p = _perhaps_drawn_in(p, config.drawn_in, rng)
        if split == "train" and config.free > 0 and rng.random() < config.free:
            p = free_form(p, rng)
        plain = isinstance(p, BottleParameters) and p.kind == "tumbler" and p.bend < PLAIN_BEND
        if config.plain_tumblers or not plain:
            return p


def _perhaps_drawn_in(can: CanParameters, share: float, rng: np.random.Generator) -> CanParameters:
    """Give a plain can or canister a foot with probability ``share``, so that it is no cue to the class."""
    if can.kind not in ("plain", "canister") or rng.random() >= share:
        return can
    return replace(can, foot=float(rng.uniform(*FOOT)))
