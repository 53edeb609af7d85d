"""Draws distractors by group, and surroundings; the held-out kinds appear in the test split alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import trimesh

from sim_assets.datasets.distractors import (
    basic,
    cartons,
    desk,
    held_out,
    kitchen,
    soft,
    surroundings,
    workshop,
)
from sim_assets.datasets.distractors.shapes import standing

Kind = Callable[[np.random.Generator], trimesh.Trimesh]

HELD_OUT_SHARE = 0.4
LARGEST = 0.44  # [m], largest extent of a distractor; larger ones are scaled down

# Tall boxes are what detectors take for bottles, so more than a third of all are packages.
_GROUPS: tuple[tuple[float, Sequence[Kind]], ...] = (
    (0.34, cartons.KINDS),
    (0.18, desk.KINDS),
    (0.14, kitchen.KINDS),
    (0.10, workshop.KINDS),
    (0.10, soft.KINDS),
    (0.14, basic.KINDS),
)
_HELD_OUT: Sequence[Kind] = held_out.KINDS


def random_distractor(rng: np.random.Generator, split: Literal["train", "test"] = "train") -> trimesh.Trimesh:
    """Return a mesh in [m], z up, resting on z = 0; its parts may overlap (it is for rendering only).

    In the test split, a share HELD_OUT_SHARE is of kinds absent from the training split.
    """
    if split == "test" and rng.random() < HELD_OUT_SHARE:
        kinds = _HELD_OUT
    else:
        shares = np.array([share for share, _ in _GROUPS])
        kinds = _GROUPS[int(rng.choice(len(_GROUPS), p=shares / shares.sum()))][1]
    mesh = kinds[int(rng.integers(len(kinds)))](rng)
    largest = float(mesh.extents.max())
    if largest > LARGEST:
        mesh.apply_scale(LARGEST / largest)
    return standing(mesh)


def random_surrounding(
    rng: np.random.Generator, split: Literal["train", "test"] = "train"
) -> trimesh.Trimesh:
    """Return a big thing in [m], z up, resting on z = 0, front towards +x, to stand around a table.

    The splits differ in their random shapes, not in their kinds: surroundings are never counted.
    """
    del split
    kinds = surroundings.KINDS
    return standing(kinds[int(rng.integers(len(kinds)))](rng))
