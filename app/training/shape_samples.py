"""Shapes of the training families as occupancy grids, sampled in shards."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from app.jobs import Workers
from app.training.files import load_arrays, packed_arrays
from app.training.shards import Contents, Progress, write_shards
from perception.errors import PerceptionError
from perception.shape.dataset import ShapeDataset
from perception.types import CATEGORIES, Category

Split = Literal["train", "test"]

SHARD = 500  # shapes per job


@dataclass(frozen=True)
class GridShard:
    """Consecutive shapes of the sequence that a seed stands for.

    Attributes:
        folder: Folder of the file.
        category: Class of the shapes.
        split: Families of the shapes.
        seed: Seed of the sequence.
        number: Number of the shard in the data set.
        first: Position of the first shape in the sequence.
        count: Number of shapes.
    """

    folder: Path
    category: Category
    split: Split
    seed: int
    number: int
    first: int
    count: int

    @property
    def files(self) -> tuple[Path]:
        """The file, for ``write_shards``."""
        name = f"{self.split}_{self.category}_seed{self.seed}_first{self.first}_n{self.count}.npz"
        return (self.folder / name,)


def cached_shapes(
    path: Path,
    counts: Mapping[Category, int],
    split: Split,
    seed: int,
    workers: Workers = Workers(),
    progress: Progress | None = None,
) -> ShapeDataset:
    """Return shapes of the families, from the cache file if it exists; finished shards are reused.

    Raises:
        PerceptionError: The cache file has other numbers of shapes, or a shard failed.
    """
    if path.exists():
        data = ShapeDataset.load(path)
        if {category: len(data.of(category)) for category in CATEGORIES} == dict(counts):
            return data
        raise PerceptionError(f"{path} holds other shapes than asked for; delete it or choose another --out")
    shards = list_shards(path.with_suffix(""), counts, split, seed)
    write_shards(shards, sample_shard, workers, f"sampling {split} shapes", progress)
    grids: dict[Category, list[np.ndarray]] = {c: [np.zeros((0, 32, 32, 32), np.uint8)] for c in counts}
    for shard in shards:
        grids[shard.category].append(load_arrays(shard.files[0], ("grids",), "shapes")["grids"])
    joined: dict[Category, np.ndarray] = {c: np.concatenate(parts) for c, parts in grids.items()}
    data = ShapeDataset.from_grids(joined)
    data.save(path)
    shutil.rmtree(path.with_suffix(""), ignore_errors=True)
    return data


def list_shards(folder: Path, counts: Mapping[Category, int], split: Split, seed: int) -> list[GridShard]:
    """Return the shards of a data set in the order of its shapes."""
    pieces: list[tuple[Category, int]] = [
        (category, first) for category, n in counts.items() for first in range(0, n, SHARD)
    ]
    return [
        GridShard(folder, category, split, seed, number, first, min(SHARD, counts[category] - first))
        for number, (category, first) in enumerate(pieces)
    ]


def sample_shard(shard: GridShard) -> Contents:
    """Sample the shapes of a shard and return the content of its file."""
    from sim_assets.objects.training_grids import sample_training_grids

    grids = sample_training_grids(shard.category, shard.count, shard.seed, shard.split, shard.first)
    return (packed_arrays(_Grids(grids), ("grids",)),)


@dataclass(frozen=True)
class _Grids:
    """Occupancy grids times 255."""

    grids: np.ndarray
