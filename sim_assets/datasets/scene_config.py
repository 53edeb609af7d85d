"""Distributions that table-top scenes are sampled from: objects, room, cameras and sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Renderer = Literal["classic", "filament"]
GRIPPABLE_TABLE = (0.75, 0.65)  # half sides of the table in scenes without a varied room [m]


@dataclass(frozen=True)
class RoomConfig:
    """What surrounds the objects.

    Attributes:
        side: range of half the side of rectangular tables, or of the radius of round ones, in [m].
        round: share of round tables.
        ground: share of images with the objects on the floor.
        drop: range of the height of the table above the floor in [m].
        wall: range of the distance of the wall behind the table from its centre, in [m].
        pool: number of surrounding things compiled together, such as chairs and shelves.
        things: smallest and largest number of them in an image.
    """

    side: tuple[float, float] = (0.32, 0.95)
    round: float = 0.2
    ground: float = 0.15
    drop: tuple[float, float] = (0.35, 0.95)
    wall: tuple[float, float] = (0.9, 4.0)
    pool: int = 10
    things: tuple[int, int] = (1, 6)


@dataclass(frozen=True)
class TrainingSceneConfig:
    """Distributions that table-top scenes are sampled from.

    Attributes:
        width, height: size of the images in pixels.
        pool, distractors: number of objects and of distractors compiled together.
        shares: relative frequencies of CATEGORIES among the objects of the pool.
        household: share of the objects with the sizes met in homes, others can be grasped.
        free: share of the training split's objects with a body of free form, where their class has any.
        filled: share of the bowls and mugs with something in them.
        toppled: share of the objects that lie or stand on their heads; their class is not to be learned.
        posed: share of the objects in one of the resting poses of their class that are told apart; their
            class alone is not to be learned.
        random_parts: share of the training split's distractors made by ``random_parts``.
        plain_tumblers: whether the bottles include straight tumblers with flat lids, which resemble cans.
        drawn_in: share of the training split's plain cans and canisters with a narrower foot.
        pictures_per_pool: number of images rendered with one pool.
        pictures_per_texture: number of images between changes of textures.
        textures_redrawn: number of items that get a new texture then; the ground always does.
        objects, extras: smallest and largest number of objects and of distractors in an image.
        gap: range of the minimum distance between neighbours in [m], sampled per image.
        stacked: share of images with one to three further objects on or in others.
        crowded: share of images in which a random share of the items touch, or nearly touch, a neighbour.
        spread: range of the half side of the square that holds the items, in [m].
        distance, elevation, fovy: ranges of the camera's distance in [m], elevation in [rad] and vertical
            field of view in [deg].
        shadows: share of images with cast shadows (slower).
        upturned: share of images with a uniformly random camera roll.
        noises: probabilities of DEPTH_NOISES.
        misregistered: share of images with errors of calibration between colour and depth.
        cut: share of images without depth beyond a limit, or at their borders.
        room: variation of the room; None for a large table in an empty one.
        renderer: renderer of the colour images; depth and instances always come from the classic one.
    """

    width: int = 320
    height: int = 240
    pool: int = 40
    distractors: int = 14
    shares: tuple[int, int, int, int] = (1, 1, 1, 1)
    household: float = 0.0
    free: float = 0.0
    filled: float = 0.0
    toppled: float = 0.0
    posed: float = 0.0
    random_parts: float = 0.0
    plain_tumblers: bool = True
    drawn_in: float = 0.0
    pictures_per_pool: int = 400
    pictures_per_texture: int = 8
    textures_redrawn: int = 12
    objects: tuple[int, int] = (3, 10)
    extras: tuple[int, int] = (0, 4)
    gap: tuple[float, float] = (0.002, 0.05)
    stacked: float = 0.0
    crowded: float = 0.6
    spread: tuple[float, float] = (0.18, 0.30)
    distance: tuple[float, float] = (0.35, 0.85)
    elevation: tuple[float, float] = (np.radians(30), np.radians(90))
    fovy: tuple[float, float] = (42.0, 50.0)
    shadows: float = 0.3
    upturned: float = 0.2
    noises: tuple[float, ...] = (0.15, 0.15, 0.7, 0.0, 0.0)
    misregistered: float = 0.0
    cut: float = 0.0
    room: RoomConfig | None = None
    renderer: Renderer = "classic"
