"""Baseline renderers with the signature of ``renderer.render``.

``render_first_crossing`` renders depth as Differentiable Volumetric Rendering does (Niemeyer, Mescheder,
Oechsle, Geiger, CVPR 2020): the first crossing of an occupancy level, refined by the secant method, with its
implicit derivative. ``render_silhouette`` renders the mask alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import warp as wp
from jaxtyping import Float

from perception.rendering.comparison_kernels import first_crossing_kernel, silhouette_kernel
from perception.rendering.renderer import RayBundle, Rendering, ShapeGrid, render
from perception.rendering.sampling import vec16
from perception.warp_runtime import launch, to_device, zeros

RendererName = Literal["probabilistic", "first_crossing", "silhouette"]
RenderFunction = Callable[[ShapeGrid, RayBundle, np.ndarray, bool], Rendering]

LEVEL = 0.5  # occupancy of the surface, as in DVR
BACKDROP = 0.1  # [m]; depth of the background behind a silhouette at depth 0


def render_first_crossing(
    shape: ShapeGrid, rays: RayBundle, A_canonical_camera: Float[np.ndarray, "v 3 4"], gradients: bool = True
) -> Rendering:
    """Render the depth of the first crossing of ``LEVEL``; arguments as in ``renderer.render``.

    Rays without a crossing have the escape depth and zero derivatives. The variance is zero.
    """
    return _launch(first_crossing_kernel, LEVEL, shape, rays, A_canonical_camera, gradients)


def render_silhouette(
    shape: ShapeGrid, rays: RayBundle, A_canonical_camera: Float[np.ndarray, "v 3 4"], gradients: bool = True
) -> Rendering:
    """Render ``BACKDROP`` times the escape probability as depth; arguments as in ``renderer.render``.

    The variance is zero.
    """
    return _launch(silhouette_kernel, BACKDROP, shape, rays, A_canonical_camera, gradients)


RENDERERS: dict[RendererName, RenderFunction] = {
    "probabilistic": render,
    "first_crossing": render_first_crossing,
    "silhouette": render_silhouette,
}


def _launch(
    kernel: Any,
    parameter: float,
    shape: ShapeGrid,
    rays: RayBundle,
    A_canonical_camera: np.ndarray,
    gradients: bool,
) -> Rendering:
    n, device = len(rays.directions), shape.device
    on_device = rays.on_device(device)
    with_code = gradients and shape.jacobian is not None
    depth, mask = (zeros(n, wp.float32, device) for _ in range(2))
    sums = zeros((n if gradients else 1, 2), wp.vec3, device)
    d_code = zeros(n if with_code else 1, vec16, device)
    launch(
        kernel,
        dim=n,
        inputs=[
            shape.occupancy,
            shape.jacobian,
            on_device.directions,
            on_device.view,
            to_device(A_canonical_camera[:, :, :3], wp.mat33, device),
            to_device(A_canonical_camera[:, :, 3], wp.vec3, device),
            on_device.depth_range,
            rays.samples,
            float(parameter),
            int(gradients),
            int(with_code),
        ],
        outputs=[depth, mask, sums, d_code],
        device=device,
    )
    d_map = None
    if gradients:
        sum_gradient, sum_depth_gradient = sums.numpy().swapaxes(0, 1)
        columns = [rays.directions[:, [k]] * sum_depth_gradient for k in range(3)]
        d_map = np.concatenate([*columns, sum_gradient], axis=1)
    return Rendering(
        depth=depth.numpy(),
        variance=np.zeros(n, np.float32),
        mask=mask.numpy(),
        d_code=d_code.numpy() if with_code else None,
        d_map=None if d_map is None else d_map.astype(np.float32),
    )
