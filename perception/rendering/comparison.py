"""The renderers that ours is compared with, behind the interface of ``renderer.render``.

``render_first_crossing`` is the depth of Differentiable Volumetric Rendering (Niemeyer, Mescheder, Oechsle,
Geiger, CVPR 2020): where each ray first enters the occupancy level, found by the secant method, with the
implicit derivative. ``render_silhouette`` sees the mask alone.
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

LEVEL = 0.5  # occupancy that counts as the surface, as in DVR
BACKDROP = 0.1  # [m] depth of what a silhouette stands before; the silhouette itself is at 0


def render_first_crossing(
    shape: ShapeGrid, rays: RayBundle, A_canonical_camera: Float[np.ndarray, "v 3 4"], gradients: bool = True
) -> Rendering:
    """Depth of the first crossing [m]; the escape depth, without derivative, where a ray finds none.

    Its variance is zero: a surface is taken for certain.
    """
    return _launch(first_crossing_kernel, LEVEL, shape, rays, A_canonical_camera, gradients)


def render_silhouette(
    shape: ShapeGrid, rays: RayBundle, A_canonical_camera: Float[np.ndarray, "v 3 4"], gradients: bool = True
) -> Rendering:
    """Depth [m] of a silhouette at 0 before a backdrop: BACKDROP times the escape probability.

    Its variance is zero.
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
        along, across = sums.numpy()[:, 1], sums.numpy()[:, 0]
        d_map = np.concatenate([rays.directions[:, [k]] * along for k in range(3)] + [across], axis=1)
    return Rendering(
        depth=depth.numpy(),
        variance=np.zeros(n, np.float32),
        mask=mask.numpy(),
        d_code=d_code.numpy() if with_code else None,
        d_map=None if d_map is None else d_map.astype(np.float32),
    )
