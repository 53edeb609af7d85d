"""The decoder near one code: a grid for every small step without running the network again.

Decoding with derivatives is the dearest part of an iteration. Log odds of occupancy are smooth in the code,
so between two decodings grids come from their linearisation: logit(o) + d logit/dz dz.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from perception.rendering.renderer import ShapeGrid
from perception.types import CATEGORIES, CODE_SIZE, Category

# Cells less occupied, and less moved by the code, are not visited until the next decoding.
SKIP_OCCUPANCY = 5e-3
SKIP_JACOBIAN = 5e-3


@runtime_checkable
class Decoder(Protocol):
    """Codes to occupancy grids; ``perception.shape.decoder.ShapeDecoder`` is one."""

    def __call__(self, category: Category, codes: Tensor) -> Tensor: ...

    def with_jacobian(self, category: Category, code: Tensor, threads: int = 1) -> tuple[Tensor, Tensor]: ...


class LinearisedShape:
    """Grids of codes near ``code``, ready to be rendered with Jacobian."""

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
        """The shape of a code nearby, with the Jacobian of ``self.code``."""
        step = (code - self.code).astype(np.float32)
        return self._shape.stepped(step) if step.any() else self._shape


@lru_cache(maxsize=2 * len(CATEGORIES))
def mean_shape(decoder: Decoder, category: Category) -> LinearisedShape:
    """The shape of code 0, where every fit of a class begins."""
    return linearise(decoder, category, np.zeros(CODE_SIZE))


def linearise(
    decoder: Decoder, category: Category, code: Float[np.ndarray, "16"], threads: int = 1
) -> LinearisedShape:
    """Decodes a code with its derivatives, on so many cores."""
    return LinearisedShape(*decode_with_jacobian(decoder, category, code, threads), code)


def decode_with_jacobian(
    decoder: Decoder, category: Category, code: Float[np.ndarray, "16"], threads: int = 1
) -> tuple[Float[np.ndarray, "r r r"], Float[np.ndarray, "r r r 16"]]:
    """The occupancy grid of one code and its derivative by the code."""
    grid, jacobian = decoder.with_jacobian(category, torch.as_tensor(code, dtype=torch.float32), threads)
    return grid.cpu().numpy(), jacobian.cpu().numpy()


def decode(decoder: Decoder, category: Category, code: Float[np.ndarray, "16"]) -> Float[np.ndarray, "r r r"]:
    """The occupancy grid of one code."""
    with torch.no_grad():
        return decoder(category, torch.as_tensor(code, dtype=torch.float32)[None])[0].cpu().numpy()
