"""Training loss of the shape prior (NodeSLAM, section "Class-Level Shape Descriptors").

Weighted binary cross-entropy plus KL divergence:

    loss = sum_voxels w BCE(logit, occupancy) + beta KL(N(mean, variance) || N(0, 1)),   mean over the batch

The weight w is 1, increased at structures thinner than three voxels (walls, handles) and further at the
handles of mugs: these are so few voxels that an unweighted sum lets their occupancy fall below the iso
level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from perception.types import CATEGORIES

Grids = Float[Tensor, "batch x y z"]


@dataclass(frozen=True)
class LossConfig:
    """Weights of the terms of the loss.

    Attributes:
        beta: Weight of the KL divergence.
        thin: Additional weight at structures thinner than three voxels and their 3^3 neighbourhoods.
        handle: Additional weight at the handle of a mug and its 3^3 neighbourhoods.
    """

    beta: float = 0.5
    thin: float = 1.0
    handle: float = 6.0


def shape_loss(
    logits: Grids,
    grids: Grids,
    weights: Grids,
    mean: Float[Tensor, "batch code"],
    log_variance: Float[Tensor, "batch code"],
    beta: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return reconstruction loss plus beta KL divergence, and the KL divergence; batch means in [nat].

    Both are 0 for an empty batch.
    """
    reconstruction = F.binary_cross_entropy_with_logits(logits, grids, weights, reduction="sum")
    divergence = 0.5 * (mean.square() + log_variance.exp() - 1.0 - log_variance).sum()
    n = max(len(grids), 1)
    return (reconstruction + beta * divergence) / n, divergence.detach() / n


def voxel_weights(
    grids: UInt8[np.ndarray, "batch x y z"], categories: Int[np.ndarray, "batch"], config: LossConfig
) -> Float[np.ndarray, "batch x y z"]:
    """Return the weight of every voxel in the reconstruction loss, at least 1; grids are in eight bits."""
    handles = np.where(handle_region(grids, categories), grids, 0)
    extra = np.float32(config.thin / 255) * _dilate(thin_structures(grids))
    extra += np.float32(config.handle / 255) * _dilate(handles)
    extra += 1.0
    return extra


def thin_structures(grids: UInt8[np.ndarray, "batch x y z"]) -> UInt8[np.ndarray, "batch x y z"]:
    """Return the white top-hat: the occupancy removed by an opening with a cube of three voxels."""
    eroded = ~_dilate(~grids)
    return grids - _dilate(eroded)


def handle_region(
    grids: UInt8[np.ndarray, "batch x y z"], categories: Int[np.ndarray, "batch"]
) -> Bool[np.ndarray, "batch x y z"]:
    """Return the voxels of mugs beyond the body along +x, where only the handle can be.

    The body is assumed to be round: from the smallest occupied x, its extent along x equals that along y.
    """
    occupied = grids > 127
    occupied_x, occupied_y = occupied.any((2, 3)), occupied.any((1, 3))
    body_end = occupied_x.argmax(1) + occupied_y.sum(1)  # first x beyond the body
    beyond = np.arange(grids.shape[1]) >= body_end[:, None]
    beyond &= (categories == CATEGORIES.index("mug"))[:, None]
    return np.broadcast_to(beyond[:, :, None, None], grids.shape)


def _dilate(grids: UInt8[np.ndarray, "batch x y z"]) -> UInt8[np.ndarray, "batch x y z"]:
    """Return the maximum over the 3^3 neighbourhood, computed separably."""
    for axis in (1, 2, 3):
        before, after = np.moveaxis(grids, axis, 0)[:-1], np.moveaxis(grids, axis, 0)[1:]
        grids = grids.copy()
        result = np.moveaxis(grids, axis, 0)
        np.maximum(result[1:], before, out=result[1:])
        np.maximum(result[:-1], after, out=result[:-1])
    return grids
