"""Occupancy grids with their classes, kept in eight bits, and mirroring that leaves conventions alone."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from perception.errors import InvalidInputError
from perception.io.arrays import read_arrays
from perception.types import CATEGORIES, GRID_RESOLUTION, Category

MUG = CATEGORIES.index("mug")


@dataclass(frozen=True)
class ShapeDataset:
    """Shapes to learn from.

    Attributes:
        grids: (n, 32, 32, 32) occupancy times 255, indexed [x, y, z] in the canonical frame.
        categories: (n,) index into CATEGORIES.
    """

    grids: UInt8[np.ndarray, "n x y z"]
    categories: Int[np.ndarray, "n"]

    def __post_init__(self) -> None:
        shape = (len(self.categories), *(GRID_RESOLUTION,) * 3)
        if self.grids.shape != shape or self.grids.dtype != np.uint8:
            raise InvalidInputError(
                f"shape grids are {self.grids.dtype} {self.grids.shape}, expected uint8 {shape}"
            )
        if len(self.categories) and not (
            0 <= self.categories.min() <= self.categories.max() < len(CATEGORIES)
        ):
            raise InvalidInputError(f"category indices must lie in 0..{len(CATEGORIES) - 1}")

    def __len__(self) -> int:
        return len(self.categories)

    @staticmethod
    def from_grids(
        grids: Mapping[Category, Float[np.ndarray, "n 32 32 32"] | UInt8[np.ndarray, "n 32 32 32"]],
    ):
        """Join grids by class; float occupancies in [0, 1] are stored in eight bits."""
        stored = [_to_bytes(array) for array in grids.values()]
        counts = [len(array) for array in stored]
        indices = np.repeat([CATEGORIES.index(category) for category in grids], counts)
        return ShapeDataset(np.concatenate(stored), indices)

    def of(self, category: Category) -> ShapeDataset:
        """The shapes of one class."""
        chosen = self.categories == CATEGORIES.index(category)
        return ShapeDataset(self.grids[chosen], self.categories[chosen])

    def save(self, path: Path) -> None:
        """Write a compressed npz; a killed process leaves no half-written file under this name."""
        temporary = path.with_suffix(".tmp.npz")
        np.savez_compressed(temporary, grids=self.grids, categories=self.categories)
        os.replace(temporary, path)

    @staticmethod
    def load(path: Path) -> ShapeDataset:
        """Read what ``save`` wrote; InvalidInputError if the file is something else."""
        try:
            arrays = read_arrays(path)
            return ShapeDataset(arrays["grids"], arrays["categories"])
        except (OSError, KeyError, ValueError) as error:
            raise InvalidInputError(
                f"cannot read the shape data {path} ({error}); delete it to regenerate it"
            ) from error

    def batches(
        self, batch_size: int, rng: np.random.Generator
    ) -> Iterator[tuple[UInt8[np.ndarray, "b 32 32 32"], Int[np.ndarray, "b"]]]:
        """One epoch in random order, mirrored at random: grids in eight bits and category indices."""
        order = rng.permutation(len(self))
        for start in range(0, len(self), batch_size):
            chosen = order[start : start + batch_size]
            yield mirrored(self.grids[chosen], self.categories[chosen], rng), self.categories[chosen]


def mirrored(
    grids: UInt8[np.ndarray, "b 32 32 32"], categories: Int[np.ndarray, "b"], rng: np.random.Generator
) -> UInt8[np.ndarray, "b 32 32 32"]:
    """Mirror half of the shapes at y = 0, and half of those without a handle at x = 0."""
    flip_y = rng.random(len(grids)) < 0.5
    flip_x = (rng.random(len(grids)) < 0.5) & (categories != MUG)
    result = np.where(flip_y[:, None, None, None], grids[:, :, ::-1], grids)
    return np.where(flip_x[:, None, None, None], result[:, ::-1], result)


def occupancies(grids: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Eight-bit grids as float32 in [0, 1]."""
    return grids.astype(np.float32) / np.float32(255)


def _to_bytes(grids: np.ndarray) -> UInt8[np.ndarray, "n 32 32 32"]:
    if grids.dtype == np.uint8:
        return grids
    if not (np.isfinite(grids).all() and grids.min(initial=0) >= 0 and grids.max(initial=0) <= 1):
        raise InvalidInputError("occupancies must be finite and lie in [0, 1]")
    return np.rint(grids * 255).astype(np.uint8)
