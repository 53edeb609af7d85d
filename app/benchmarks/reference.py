"""Reference implementations in plain torch, with derivatives by autograd."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from perception.inference.observation import PixelSet
from perception.inference.problem import FitState, NoiseConfig
from perception.rendering.pose import canonical_from_camera
from perception.rendering.reference import ReferenceRendering, render_reference
from perception.rendering.renderer import RayBundle
from perception.shape.network import DecoderNetwork, ShapeVae, class_one_hot
from perception.types import CATEGORIES, CODE_SIZE, Category


def plain_render(grid: Tensor, rays: RayBundle, A_canonical_camera: Tensor) -> ReferenceRendering:
    """Render a bundle of rays by the reference renderer."""
    return render_reference(
        grid,
        torch.from_numpy(rays.directions).to(grid),
        torch.from_numpy(rays.view).to(grid.device),
        A_canonical_camera,
        torch.from_numpy(rays.depth_range).to(grid),
        rays.samples,
    )


def plain_jacobian_rows(
    grid: np.ndarray, jacobian: np.ndarray, rays: RayBundle, A_canonical_camera: np.ndarray
) -> Callable[[], Tensor]:
    """Return a job: the depth's Jacobian with respect to code and camera map, one backward pass per ray."""
    start, by_code = torch.from_numpy(grid), torch.from_numpy(jacobian)
    code = torch.zeros(CODE_SIZE, requires_grad=True)
    A = torch.from_numpy(A_canonical_camera).float().requires_grad_()

    def rows() -> Tensor:
        image = plain_render(start + by_code @ code, rays, A)
        out = []
        for depth in image.depth:
            by_parameters = torch.autograd.grad(depth, (code, A), retain_graph=True)
            out.append(torch.cat([part.flatten() for part in by_parameters]))
        return torch.stack(out)

    return rows


def plain_decoder(model: ShapeVae, category: Category) -> Callable[[Tensor], Tensor]:
    """Return the decoder from codes (batch, 16) to grids in the layers of the paper."""
    net = model.decoder
    one_hot = class_one_hot(torch.tensor([CATEGORIES.index(category)]))

    def decode(codes: Tensor) -> Tensor:
        x = F.relu(net.linear0(torch.cat([codes, one_hot.expand(len(codes), -1)], dim=1)))
        x = F.relu(net.linear1(x)).unflatten(1, (-1, 2, 2, 2))
        for layer in (net.up2, net.up3, net.up4):
            x = F.relu(layer(x))
        return torch.sigmoid(F.conv_transpose3d(x, net.out_weight, net.out_bias, stride=2, padding=1)[:, 0])

    return decode


def gradient_step(
    decoder: DecoderNetwork, category: Category, pixels: PixelSet, state: FitState, noise: NoiseConfig
) -> Callable[[], tuple[Tensor, ...]]:
    """Return a job: the gradient of a fit's cost with respect to code and camera maps."""
    A = torch.from_numpy(canonical_from_camera(state.pose, pixels.Ts_world_camera)).float().requires_grad_()
    code = torch.from_numpy(state.code).float()[None].requires_grad_()
    one_hot = class_one_hot(torch.tensor([CATEGORIES.index(category)]))
    target, weight = torch.from_numpy(pixels.target), torch.from_numpy(pixels.weight)

    def gradient() -> tuple[Tensor, ...]:
        image = plain_render(torch.sigmoid(decoder(code, one_hot))[0], pixels.rays, A)
        sigma2 = image.variance.detach() + noise.depth_sigma**2
        cost = (weight * (image.depth - target) ** 2 / sigma2).sum() + noise.code_prior * (code**2).sum()
        return torch.autograd.grad(cost, (code, A))

    return gradient
