"""Trained decoder: a shape code to its occupancy grid, and the derivatives with respect to the code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.shape.sparse_decoder import SparseDecoder
from perception.shape.weights import read_decoder_weights
from perception.types import CATEGORIES, CODE_SIZE, Category


class ShapeDecoder:
    """Decoder of shape codes; the prior of a code is N(0, I) in each category.

    Grids are (32, 32, 32) occupancy probabilities indexed [x, y, z] in the canonical cube [-1, 1]^3.

    Args:
        weights: Parameters of ``network.DecoderNetwork`` by name.
        device: ``cpu`` or ``cuda``; results are in the host's memory in any case.
    """

    def __init__(self, weights: Mapping[str, np.ndarray], device: str = "cpu") -> None:
        self.device = device
        self._sparse = SparseDecoder(weights, "cpu" if device == "cpu" else "cuda:0")

    @staticmethod
    def load(path: Path | None = None, device: str = "cpu") -> ShapeDecoder:
        """Load the shipped weights, or those of a file; raises as ``read_decoder_weights``."""
        return ShapeDecoder(read_decoder_weights(path), device)

    def __call__(self, category: Category, code: Float[np.ndarray, "code"]) -> Float[np.ndarray, "x y z"]:
        """Return the occupancy grid of one code.

        Raises:
            InvalidInputError: The code is not of shape (16,).
        """
        return self._sparse(_checked(code), CATEGORIES.index(category), False)[0]

    def with_jacobian(
        self, category: Category, code: Float[np.ndarray, "code"], threads: int = 1
    ) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z code"]]:
        """Return the grid of one code and its Jacobian d occupancy / d code, both contiguous.

        ``threads`` cores share the work on the CPU.

        Raises:
            InvalidInputError: The code is not of shape (16,).
        """
        grid, jacobian = self._sparse(_checked(code), CATEGORIES.index(category), True, threads)
        assert jacobian is not None
        return grid, jacobian


def _checked(code: np.ndarray) -> Float[np.ndarray, "16"]:
    if code.shape != (CODE_SIZE,):
        raise InvalidInputError(f"the shape code is {code.shape}, expected ({CODE_SIZE},)")
    return np.asarray(code, np.float32)
