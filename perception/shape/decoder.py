"""The trained decoder: shape codes to occupancy grids, and their derivatives in the codes.

The derivative is one batched forward-mode pass: the value and its 16 tangents go through the layers together,
as 17 inputs. Layers are linear, so tangents pass through them without the bias; a ReLU lets a tangent through
where the value is positive. That is exact, and needs neither autograd nor 16 passes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from perception.errors import InvalidInputError
from perception.shape.network import Decoder, channels_last, corner_weight, depth_to_space
from perception.shape.weights import load_weights
from perception.types import CATEGORIES, CODE_SIZE, GRID_RESOLUTION, Category

Codes = Float[Tensor, "batch code"] | Float[np.ndarray, "batch code"]


class ShapeDecoder:
    """Occupancy grids of a category from codes of 16 numbers, standard normal over the category.

    Grids are (32, 32, 32) occupancy probabilities indexed [x, y, z] in the canonical cube [-1, 1]^3.
    """

    def __init__(self, network: Decoder, device: str | torch.device = "cpu") -> None:
        self.device = torch.device(device)
        channels_last(network, self.device)
        self._network = network.eval().requires_grad_(False)
        self._corner_weight = corner_weight(network.out_weight).contiguous(
            memory_format=torch.channels_last_3d
        )
        self._one_hot = torch.eye(len(CATEGORIES), device=self.device)

    @staticmethod
    def load(path: Path | None = None, device: str | torch.device = "cpu") -> ShapeDecoder:
        """The decoder with the shipped weights, or those of a file; raises PerceptionError if unusable."""
        return ShapeDecoder(load_weights(path, device).decoder, device)

    def logits(self, category: Category, codes: Codes) -> Float[Tensor, "batch x y z"]:
        """Log odds of occupancy. Differentiable in the codes."""
        codes = torch.as_tensor(codes, dtype=torch.float32, device=self.device)
        if codes.ndim != 2 or codes.shape[1] != CODE_SIZE:
            raise InvalidInputError(f"shape codes are {tuple(codes.shape)}, expected (batch, {CODE_SIZE})")
        return self._network(codes, self._class_vector(category).expand(len(codes), -1))

    def __call__(self, category: Category, codes: Codes) -> Float[Tensor, "batch x y z"]:
        """Occupancy probabilities. Differentiable in the codes."""
        return torch.sigmoid(self.logits(category, codes))

    @torch.no_grad()
    def with_jacobian(
        self, category: Category, code: Float[Tensor, "code"] | Float[np.ndarray, "code"]
    ) -> tuple[Float[Tensor, "x y z"], Float[Tensor, "x y z code"]]:
        """The grid of one code and its derivative d occupancy / d code, contiguous, code axis last."""
        code = torch.as_tensor(code, dtype=torch.float32, device=self.device)
        if code.shape != (CODE_SIZE,):
            raise InvalidInputError(f"the shape code is {tuple(code.shape)}, expected ({CODE_SIZE},)")
        net = self._network
        # row 0 is the value, rows 1..16 are its derivatives in the 16 codes
        x = net.linear0.weight[:, :CODE_SIZE].T  # (16, c5)
        value = net.linear0(torch.cat([code, self._class_vector(category)]))
        x = _relu_rows(torch.cat([value[None], x]))  # (17, c5)
        x = _relu_rows(_add_bias(F.linear(x, net.linear1.weight), net.linear1.bias))  # (17, 8 c4)
        x = x.unflatten(1, (-1, 2, 2, 2))
        for layer in (net.up2, net.up3, net.up4):  # to (17, c1, 16, 16, 16)
            x = F.conv_transpose3d(x, layer.weight, stride=2, padding=1)
            x = _relu_rows(_add_bias(x, layer.bias))
        corners = F.conv3d(x, self._corner_weight, padding=1)  # (17, 8, 17, 17, 17)
        logits = depth_to_space(corners)[:, 0, 1:-1, 1:-1, 1:-1]  # (17, 32, 32, 32)
        grid = torch.sigmoid(logits[0] + net.out_bias)
        slope = grid * (1.0 - grid)
        jacobian = torch.empty((*(GRID_RESOLUTION,) * 3, CODE_SIZE), device=self.device)
        torch.mul(logits[1:].permute(1, 2, 3, 0), slope[..., None], out=jacobian)
        return grid, jacobian

    def _class_vector(self, category: Category) -> Float[Tensor, "category"]:
        return self._one_hot[CATEGORIES.index(category)]


def _add_bias(
    x: Float[Tensor, "row channel *space"], bias: Tensor | None
) -> Float[Tensor, "row channel *space"]:
    """Add the bias, in place, to the value alone: it is constant, so derivatives don't see it."""
    assert bias is not None
    x[0] += bias.reshape(-1, *(1,) * (x.ndim - 2))
    return x


def _relu_rows(x: Float[Tensor, "row channel *space"]) -> Float[Tensor, "row channel *space"]:
    """ReLU, in place, of the value in row 0 and of the derivatives in the others."""
    return x.mul_((x[:1] > 0).to(x.dtype))
