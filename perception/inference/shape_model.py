"""Linearisation of the decoder around a code: grids of nearby codes without evaluating the network.

Decoding with derivatives is the most expensive part of an iteration. The log odds of occupancy are smooth in
the code, so between two decodings grids come from their linearisation: logit(o) + d logit/dz dz.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from perception.rendering.renderer import ShapeGrid
from perception.types import CATEGORIES, CODE_SIZE, Category

# Cells with smaller occupancies and derivatives are skipped until the next decoding.
SKIP_OCCUPANCY = 5e-3
SKIP_JACOBIAN = 5e-3


@runtime_checkable
class Decoder(Protocol):
    """Interface of a shape prior; ``perception.shape.decoder.ShapeDecoder`` implements it."""

    def __call__(self, category: Category, code: Float[np.ndarray, "16"]) -> Float[np.ndarray, "r r r"]:
        """Return the occupancy grid of one code."""
        ...

    def with_jacobian(
        self, category: Category, code: Float[np.ndarray, "16"], threads: int = 1
    ) -> tuple[Float[np.ndarray, "r r r"], Float[np.ndarray, "r r r 16"]]:
        """Return the occupancy grid of one code and its derivative with respect to the code."""
        ...


class LinearisedShape:
    """Grids of codes near ``code``, uploaded for rendering with Jacobian."""

    def __init__(
        self,
        grid: Float[np.ndarray, "r r r"],
        jacobian: Float[np.ndarray, "r r r 16"],
        code: Float[np.ndarray, "16"],
    ) -> None:
        self.code = np.array(code, dtype=np.float64)
        self.grid = grid
        self._shape = ShapeGrid.upload(grid, jacobian, "cpu", SKIP_OCCUPANCY, SKIP_JACOBIAN)

    def at(self, code: Float[np.ndarray, "16"]) -> ShapeGrid:
        """Return the shape of a nearby code, with the Jacobian at ``self.code``."""
        step = (code - self.code).astype(np.float32)
        return self._shape.stepped(step) if step.any() else self._shape


@lru_cache(maxsize=2 * len(CATEGORIES))
def mean_shape(decoder: Decoder, category: Category) -> LinearisedShape:
    """Return the shape of code 0, the initial shape of every fit of a class."""
    return linearise(decoder, category, np.zeros(CODE_SIZE))


def linearise(
    decoder: Decoder, category: Category, code: Float[np.ndarray, "16"], threads: int = 1
) -> LinearisedShape:
    """Decode a code with its derivatives on ``threads`` cores."""
    return LinearisedShape(*decoder.with_jacobian(category, code, threads), code)
