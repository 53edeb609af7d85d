"""Reference implementation of the probabilistic renderer in PyTorch.

Follows NodeSLAM, section "Probabilistic Rendering", equation by equation. Slow, differentiable by autograd;
the kernels are tested against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from perception.rendering.kernel import ESCAPE_FACTOR


@dataclass(frozen=True)
class ReferenceRendering:
    """Expected depth [m], its variance [m^2] and the probability that the ray hits the object."""

    depth: Float[Tensor, "n"]
    variance: Float[Tensor, "n"]
    mask: Float[Tensor, "n"]


def sample_depths(depth_range: Float[Tensor, "n 2"], samples: int) -> Float[Tensor, "n m"]:
    """Return the sample depths: delta_i = delta_min + i / M (delta_max - delta_min), i = 1..M."""
    steps = torch.arange(1, samples + 1, dtype=depth_range.dtype, device=depth_range.device) / samples
    near, far = depth_range[:, :1], depth_range[:, 1:]
    return near + steps * (far - near)


def interpolate(grid: Float[Tensor, "r r r"], points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    """Interpolate the occupancy at canonical points trilinearly; voxels outside the grid are empty."""
    # grid_sample expects coordinates in the order (z, y, x).
    flat = points.flip(-1).reshape(1, 1, 1, -1, 3)
    values = functional.grid_sample(
        grid[None, None], flat, mode="bilinear", padding_mode="zeros", align_corners=False
    )
    return values.reshape(points.shape[:-1])


def termination(
    occupancy: Float[Tensor, "n m"],
) -> tuple[Float[Tensor, "n m"], Float[Tensor, "n"]]:
    """Return the termination probabilities phi_i = o_i prod_{j<i} (1 - o_j) and the escape probability.

    >>> termination(torch.tensor([[0.5, 0.5, 1.0]]))
    (tensor([[0.5000, 0.2500, 0.2500]]), tensor([0.]))
    """
    transmittance = torch.cumprod(1 - occupancy, dim=-1)
    reaching = torch.cat([torch.ones_like(transmittance[:, :1]), transmittance[:, :-1]], dim=-1)
    return occupancy * reaching, transmittance[:, -1]


def aggregate(
    occupancy: Float[Tensor, "n m"], depths: Float[Tensor, "n m"], escape_depth: Float[Tensor, "n"]
) -> ReferenceRendering:
    """Return expectation and variance of the depth, and the mask, for sampled occupancies."""
    phi, escape = termination(occupancy)
    phi = torch.cat([phi, escape[:, None]], dim=-1)
    delta = torch.cat([depths, escape_depth[:, None]], dim=-1)
    depth = (phi * delta).sum(-1)
    variance = (phi * (delta - depth[:, None]) ** 2).sum(-1)
    return ReferenceRendering(depth, variance, 1 - escape)


def render_reference(
    grid: Float[Tensor, "r r r"],
    directions: Float[Tensor, "n 3"],
    view: Int[Tensor, "n"],
    A_canonical_camera: Float[Tensor, "v 3 4"],
    depth_range: Float[Tensor, "v 2"],
    samples: int,
) -> ReferenceRendering:
    """Render a grid; arguments as in ``renderer.render`` and ``renderer.RayBundle``."""
    depths = sample_depths(depth_range[view], samples)
    points_camera = depths[..., None] * directions[:, None]
    A = A_canonical_camera[view]
    points = torch.einsum("nij,nmj->nmi", A[:, :, :3], points_camera) + A[:, None, :, 3]
    return aggregate(interpolate(grid, points), depths, ESCAPE_FACTOR * depth_range[view, 1])
