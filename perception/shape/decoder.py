"""Trained decoder: shape codes to occupancy grids, and derivatives with respect to the code.

Batches of codes and autograd use PyTorch; a single code with its Jacobian, as needed in every iteration of
a fit, uses ``sparse_decoder.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from perception.errors import InvalidInputError
from perception.shape.network import DecoderNetwork, channels_last
from perception.shape.sparse_decoder import SparseDecoder
from perception.shape.weights import load_weights
from perception.types import CATEGORIES, CODE_SIZE, Category

Codes = Float[Tensor, "batch code"] | Float[np.ndarray, "batch code"]


class ShapeDecoder:
    """Decoder of shape codes; the prior of a code is N(0, I) in each category.

    Grids are (32, 32, 32) occupancy probabilities indexed [x, y, z] in the canonical cube [-1, 1]^3.
    """

    def __init__(self, network: DecoderNetwork, device: str | torch.device = "cpu") -> None:
        self.device = torch.device(device)
        channels_last(network, self.device)
        self._network = network.eval().requires_grad_(False)
        self._sparse = SparseDecoder(network, "cpu" if self.device.type == "cpu" else "cuda:0")
        self._one_hot = torch.eye(len(CATEGORIES), device=self.device)

    @staticmethod
    def load(path: Path | None = None, device: str | torch.device = "cpu") -> ShapeDecoder:
        """Load the shipped weights, or those of a file; arguments and errors as in ``load_weights``."""
        return ShapeDecoder(load_weights(path, device).decoder, device)

    def logits(self, category: Category, codes: Codes) -> Float[Tensor, "batch x y z"]:
        """Return the log odds of occupancy, differentiable with respect to the codes.

        Raises:
            InvalidInputError: The codes are not of shape (batch, 16).
        """
        codes = torch.as_tensor(codes, dtype=torch.float32, device=self.device)
        if codes.ndim != 2 or codes.shape[1] != CODE_SIZE:
            raise InvalidInputError(f"shape codes are {tuple(codes.shape)}, expected (batch, {CODE_SIZE})")
        return self._network(codes, self._class_vector(category).expand(len(codes), -1))

    def __call__(self, category: Category, codes: Codes) -> Float[Tensor, "batch x y z"]:
        """Return the occupancy probabilities, differentiable with respect to the codes."""
        return torch.sigmoid(self.logits(category, codes))

    @torch.no_grad()
    def with_jacobian(
        self, category: Category, code: Float[Tensor, "code"] | Float[np.ndarray, "code"], threads: int = 1
    ) -> tuple[Float[Tensor, "x y z"], Float[Tensor, "x y z code"]]:
        """Return the grid of one code and its Jacobian d occupancy / d code, both contiguous.

        ``threads`` cores share the work on the CPU.

        Raises:
            InvalidInputError: The code is not of shape (16,).
        """
        code = torch.as_tensor(code, dtype=torch.float32, device=self.device)
        if code.shape != (CODE_SIZE,):
            raise InvalidInputError(f"the shape code is {tuple(code.shape)}, expected ({CODE_SIZE},)")
        index = CATEGORIES.index(category)
        grid, jacobian = self._sparse(code.cpu().numpy(), index, True, threads)
        assert jacobian is not None
        return grid, jacobian

    def _class_vector(self, category: Category) -> Float[Tensor, "category"]:
        return self._one_hot[CATEGORIES.index(category)]
