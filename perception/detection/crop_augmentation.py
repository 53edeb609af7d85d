"""Random variation of training crops: mirroring, truncation, deformation, noise and colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from perception.detection.crop_network import mirror_yaw_bins
from perception.detection.tasks import DIRECTIONS, Task


@dataclass(frozen=True)
class Draws:
    """Random numbers of some rows of a batch, drawn for all its rows: they do not depend on which are used.

    Attributes:
        generator: Source of randomness.
        whole: Number of rows in the batch.
        rows: Rows in use.
    """

    generator: torch.Generator
    whole: int
    rows: slice = field(default_factory=lambda: slice(None))

    def uniform(self, *shape: int) -> Tensor:
        """Return numbers in 0..1, an array of this shape for each row in use."""
        return torch.rand(self.whole, *shape, generator=self.generator)[self.rows]

    def normal(self, *shape: int) -> Tensor:
        """Return standard normal numbers, an array of this shape for each row in use."""
        return torch.randn(self.whole, *shape, generator=self.generator)[self.rows]


def mirror_crops(task: Task, images: Tensor, targets: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
    """Flip half of the crops left to right; a direction relative to the view changes its sign."""
    flip = draws.uniform().to(images.device) < 0.5
    images = torch.where(flip[:, None, None, None], images.flip(2), images)
    if task in DIRECTIONS:
        targets = torch.where(flip[:, None], mirror_yaw_bins(targets), targets)
    return images, targets


def truncate_crops(images: UInt8[Tensor, "n side side 6"], draws: Draws) -> UInt8[Tensor, "n side side 6"]:
    """Set a band along one side to 0 in three of ten crops, as if the image border truncated them."""
    side = images.shape[1]
    draw = draws.uniform(4).to(images.device)
    ramp = torch.arange(side, device=images.device)
    ramp = torch.where((draw[:, 1] < 0.5)[:, None], ramp, side - 1 - ramp)  # from either side
    kept = (ramp >= (0.4 * side * draw[:, 0])[:, None]) | (draw[:, 3] > 0.3)[:, None]  # (n, side)
    along_rows = (draw[:, 2] < 0.5)[:, None, None]
    return images * torch.where(along_rows, kept[:, :, None], kept[:, None, :])[..., None]


def warp_crops(
    inputs: Float[Tensor, "n 6 side side"], draws: Draws, most: float = 0.05
) -> Float[Tensor, "n 6 side side"]:
    """Deform the shapes: width varying with height, height, shear and shift.

    This imitates shapes outside the training families and, by the shift, inexact bounding boxes of masks.

    Args:
        inputs: Normalised crops.
        draws: Random numbers.
        most: Largest relative change of width, height and shear; the shift is at most 2.5 times as much of
            half the crop's side.
    """
    side = inputs.shape[2]
    draw = (2 * draws.uniform(9) - 1).to(inputs.device) * most
    across = torch.linspace(-1, 1, side, device=inputs.device)
    wider = functional.interpolate(draw[:, None, :5], side, mode="linear", align_corners=True)[:, 0]
    left, lean, up, higher = (draw[:, k, None, None] for k in (5, 6, 7, 8))
    u = across * (1 + wider[:, :, None]) + lean * across[:, None] + 2.5 * left  # (n, rows, columns)
    v = (across[:, None] * (1 + higher) + 2.5 * up).expand_as(u)
    grid = torch.stack([u, v], dim=-1)
    return functional.grid_sample(inputs, grid, padding_mode="border", align_corners=True)


def perturb_crops(
    inputs: Float[Tensor, "n 6 side side"], context: Float[Tensor, "n 2"], draws: Draws
) -> tuple[Float[Tensor, "n 6 side side"], Float[Tensor, "n 2"]]:
    """Vary colours (``vary_colours``) and add noise to heights, depths, crop size and elevation."""
    side = inputs.shape[2]
    draw = draws.uniform(3).to(inputs.device) * 2 - 1  # uniform in -1..1
    noise = draws.normal(1, side, side).to(inputs.device)
    noise = noise * (0.03 * draw[:, :1].abs())[..., None, None]  # decimetres; larger depth is smaller height
    colours = vary_colours(inputs[:, :3], draws)
    out = torch.cat([colours, inputs[:, 3:4], inputs[:, 4:5] - noise, inputs[:, 5:6] + noise], dim=1)
    return out.contiguous(memory_format=torch.channels_last), context + 0.03 * draw[:, 1:]


def vary_colours(colours: Float[Tensor, "n 3 side side"], draws: Draws) -> Float[Tensor, "n 3 side side"]:
    """Vary the appearance, so that the network relies on shape more than on colour.

    Gamma, gain and tint for every crop; a shading gradient, grey or a uniform colour for some; permuted
    channels for some batches.
    """
    side = colours.shape[2]
    draw = draws.uniform(12).to(colours.device)
    odds = draw[:, :, None, None, None]  # (n, 12, 1, 1, 1)
    image = ((colours + 0.9) / 2).clamp(1e-3, 1)  # back to 0..1
    image = image ** (0.5 + odds[:, 0]) * ((0.5 + 1.1 * odds[:, 1]) * (0.85 + 0.3 * draw[:, 2:5, None, None]))
    across = torch.linspace(-0.5, 0.5, side, device=colours.device)
    slope = (2 * draw[:, 5:7, None, None] - 1) * (odds[:, 7] < 0.4)
    image = image * (1 + slope[:, :1] * across[:, None] + slope[:, 1:] * across)
    image = torch.where(odds[:, 8] < 0.08, image.mean(1, keepdim=True), image)
    image = torch.where(odds[:, 9] < 0.03, odds[:, 10], image)
    if torch.rand(1, generator=draws.generator) < 0.1:
        image = image[:, torch.randperm(3, generator=draws.generator)]
    return 2 * image.clamp(0, 1) - 0.9
