"""Class-conditional variational autoencoder of occupancy grids (NodeSLAM, "Class-Level Shape Descriptors")::

    encoder  grid 32^3 and class  ->  5 convolutions, kernel 4, stride 2  ->  mean, log variance of the code
    decoder  code (16) and class  ->  linear, 5 transposed convolutions   ->  32^3 logits of occupancy

ReLU activations, no normalisation layers. Conditional VAE: Kingma and Welling 2014; Sohn et al. 2015.

Three layers have a mathematically equal, faster form:

- The one-hot class, concatenated to every voxel, adds to the first convolution a map that depends on the
  class alone and is constant except at the border (``class_bias_maps``).
- A convolution of kernel 4, stride 2, padding 1 between 2^3 and 1^3 voxels uses eight taps: it is linear.
- The last transposed convolution equals a convolution of kernel 2 over the corners between voxels, whose
  eight outputs are the eight fine voxels around each corner (``corner_weight``, ``depth_to_space``).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from perception.shape.architecture import CHANNELS
from perception.types import CATEGORIES, CODE_SIZE, GRID_RESOLUTION

# Initial logit of every voxel: about a tenth of the cube is occupied.
_EMPTY_LOGIT = -2.2

Grids = Float[Tensor, "batch x y z"]
Codes = Float[Tensor, "batch code"]
OneHot = Float[Tensor, "batch category"]


class ShapeVae(nn.Module):
    """Encoder and decoder over the four categories; grids are indexed [x, y, z] in the canonical frame."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = EncoderNetwork()
        self.decoder = DecoderNetwork()

    def forward(self, grids: Grids, one_hot: OneHot, noise: Codes) -> tuple[Grids, Codes, Codes]:
        """Return the logits of the reconstruction, and mean and log variance of the code.

        The code is sampled by reparametrisation, mean + noise * standard deviation, with ``noise`` standard
        normal (or zero).
        """
        mean, log_variance = self.encoder(grids, one_hot)
        codes = mean + noise * torch.exp(0.5 * log_variance)
        return self.decoder(codes, one_hot), mean, log_variance

    def initialise(self, generator: torch.Generator) -> ShapeVae:
        """Draw variance-preserving weights for ReLU layers (He et al. 2015); biases are zero."""
        for name, parameter in self.named_parameters():
            nn.init.zeros_(parameter)
            if name.endswith("weight"):
                # An output of a transposed convolution of stride 2 uses 8 of its 64 taps.
                transposed = parameter.ndim == 5 and name.startswith("decoder")
                fan_in = 8 * parameter.shape[0] if transposed else parameter[0].numel()
                nn.init.normal_(parameter, std=math.sqrt(2.0 / fan_in), generator=generator)
        with torch.no_grad():
            self.encoder.to_code.weight.mul_(0.1)  # start close to the prior N(0, 1)
            self.decoder.out_weight.mul_(0.1)
            self.decoder.out_bias.fill_(_EMPTY_LOGIT)
        return self


class EncoderNetwork(nn.Module):
    """Occupancy grid and class to the mean and log variance of the shape code."""

    def __init__(self) -> None:
        super().__init__()
        c1, c2, c3, c4, c5 = CHANNELS
        self.conv1 = nn.Conv3d(1 + len(CATEGORIES), c1, 4, stride=2, padding=1)
        self.conv2 = nn.Conv3d(c1, c2, 4, stride=2, padding=1)
        self.conv3 = nn.Conv3d(c2, c3, 4, stride=2, padding=1)
        self.conv4 = nn.Conv3d(c3, c4, 4, stride=2, padding=1)
        self.linear5 = nn.Linear(8 * c4, c5)  # convolution 2^3 -> 1^3, inputs flattened as (channel, x, y, z)
        self.to_code = nn.Linear(c5, 2 * CODE_SIZE)

    def forward(self, grids: Grids, one_hot: OneHot) -> tuple[Codes, Codes]:
        x = F.conv3d(grids[:, None], self.conv1.weight[:, :1], self.conv1.bias, stride=2, padding=1)
        bias_maps = class_bias_maps(self.conv1.weight[:, 1:], GRID_RESOLUTION)  # (category, c1, 16, 16, 16)
        x += bias_maps[one_hot.argmax(1)]
        x = F.relu_(x)  # (batch, c1, 16, 16, 16)
        x = F.relu_(self.conv2(x))  # (batch, c2, 8, 8, 8)
        x = F.relu_(self.conv3(x))  # (batch, c3, 4, 4, 4)
        x = F.relu_(self.conv4(x))  # (batch, c4, 2, 2, 2)
        x = F.relu_(self.linear5(x.flatten(1)))  # (batch, c5)
        mean, log_variance = self.to_code(x).chunk(2, dim=1)
        return mean, log_variance


class DecoderNetwork(nn.Module):
    """Shape code and class to logits of occupancy."""

    def __init__(self) -> None:
        super().__init__()
        c1, c2, c3, c4, c5 = CHANNELS
        self.linear0 = nn.Linear(CODE_SIZE + len(CATEGORIES), c5)
        self.linear1 = nn.Linear(c5, 8 * c4)  # transposed convolution 1^3 -> 2^3, outputs (channel, x, y, z)
        self.up2 = nn.ConvTranspose3d(c4, c3, 4, stride=2, padding=1)
        self.up3 = nn.ConvTranspose3d(c3, c2, 4, stride=2, padding=1)
        self.up4 = nn.ConvTranspose3d(c2, c1, 4, stride=2, padding=1)
        self.out_weight = nn.Parameter(torch.zeros(c1, 1, 4, 4, 4))  # of a fifth transposed convolution
        self.out_bias = nn.Parameter(torch.zeros(1))

    def forward(self, codes: Codes, one_hot: OneHot) -> Grids:
        x = F.relu_(self.linear0(torch.cat([codes, one_hot], dim=1)))  # (batch, c5)
        x = F.relu_(self.linear1(x)).unflatten(1, (-1, 2, 2, 2))  # (batch, c4, 2, 2, 2)
        x = F.relu_(self.up2(x))  # (batch, c3, 4, 4, 4)
        x = F.relu_(self.up3(x))  # (batch, c2, 8, 8, 8)
        x = F.relu_(self.up4(x))  # (batch, c1, 16, 16, 16)
        corners = F.conv3d(x, corner_weight(self.out_weight), padding=1)  # (batch, 8, 17, 17, 17)
        return depth_to_space(corners)[:, 0, 1:-1, 1:-1, 1:-1] + self.out_bias  # (batch, 32, 32, 32)


def channels_last(module: nn.Module, device: str | torch.device) -> None:
    """Move a network to a device, in place, with convolution weights in channels-last memory format."""
    module.to(device)
    for parameter in module.parameters():
        if parameter.ndim == 5:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last_3d)


def class_one_hot(category_index: Int[Tensor, "batch"]) -> OneHot:
    """Return one-hot classes in the order of CATEGORIES."""
    return F.one_hot(category_index, len(CATEGORIES)).float()


def class_bias_maps(
    weight: Float[Tensor, "out category 4 4 4"], resolution: int
) -> Float[Tensor, "category out half half half"]:
    """Return the kernel-4, stride-2, padding-1 convolution of a grid of ones, for every class.

    Along each axis the result is (first, middle, ..., middle, last): computed on 6^3 voxels, then expanded.
    """
    ones = torch.eye(weight.shape[1], device=weight.device, dtype=weight.dtype)
    small = F.conv3d(ones[:, :, None, None, None].expand(-1, -1, 6, 6, 6), weight, stride=2, padding=1)
    expansion = torch.ones(resolution // 2, dtype=torch.long, device=weight.device)
    expansion[0], expansion[-1] = 0, 2
    return small[:, :, expansion][:, :, :, expansion][:, :, :, :, expansion]


def corner_weight(weight: Float[Tensor, "inp out 4 4 4"]) -> Float[Tensor, "out8 inp 2 2 2"]:
    """Return the kernel-2 weight over corners of a kernel-4, stride-2, padding-1 transposed convolution.

    In one dimension corner c lies between the coarse voxels c - 1 and c, and between the fine voxels 2c - 1
    and 2c. Fine voxel f reads coarse voxel i through tap f + 1 - 2i: phase 0 (f = 2c - 1) reads the voxels
    c - 1 and c through taps 2 and 0, phase 1 (f = 2c) through taps 3 and 1.
    """
    inputs, outputs = weight.shape[:2]
    taps = weight.reshape(inputs, outputs, 2, 2, 2, 2, 2, 2).flip(
        2, 4, 6
    )  # (i, o, voxel x, phase x, voxel y..)
    return taps.permute(1, 3, 5, 7, 0, 2, 4, 6).reshape(8 * outputs, inputs, 2, 2, 2)


def depth_to_space(
    x: Float[Tensor, "batch channel8 x y z"],
) -> Float[Tensor, "batch channel x2 y2 z2"]:
    """Rearrange eight channels to 2^3 finer voxels: channel (c, px, py, pz) goes to (2x+px, 2y+py, 2z+pz)."""
    batch, channels, nx, ny, nz = x.shape
    x = x.reshape(batch, channels // 8, 2, 2, 2, nx, ny, nz).permute(0, 1, 5, 2, 6, 3, 7, 4)
    return x.reshape(batch, channels // 8, 2 * nx, 2 * ny, 2 * nz)
