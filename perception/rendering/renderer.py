"""Probabilistic renderer: host side of the fused kernels, arrays in and arrays out.

``reference.py`` is the plain version of the same equations (NodeSLAM, section "Probabilistic Rendering").
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from perception.rendering.kernel import (
    ESCAPE_FACTOR,
    PADDED_VOXELS,
    flag_cells_kernel,
    pad_kernel,
    render_kernel,
    step_kernel,
    vec16,
)
from perception.types import GRID_RESOLUTION
from perception.warp_runtime import empty, launch, start_warp, to_device, zeros

_VOXELS = (GRID_RESOLUTION,) * 3
_CELLS = (GRID_RESOLUTION + 1,) * 3


@dataclass(frozen=True)
class ShapeGrid:
    """An occupancy grid and, where wanted, its Jacobian by the code, on one device.

    Attributes:
        occupancy: flat, with a border of empty voxels.
        jacobian: d occupancy / d code in the same layout, or None.
        cells: flags of the cells between eight voxels, by their lowest one; 0 where there is nothing to see.
        flags: the same of voxels, and which of them stay as they are.
        device: "cpu" or "cuda:0".
    """

    occupancy: wp.array
    jacobian: wp.array | None
    cells: wp.array
    flags: wp.array
    device: str

    @staticmethod
    def upload(
        occupancy: Float[np.ndarray, "r r r"],
        jacobian: Float[np.ndarray, "r r r 16"] | None = None,
        device: str = "cpu",
        skip_occupancy: float = 0.0,
        skip_jacobian: float = 0.0,
    ) -> ShapeGrid:
        """Brings a grid to the device and flags the cells worth a visit.

        Args:
            occupancy: G[ix, iy, iz] in 0..1.
            jacobian: d occupancy / d code.
            device: "cpu" or "cuda:0".
            skip_occupancy: cells with no corner above this count as empty.
            skip_jacobian: cells with no derivative above this count as unmoved by the code.
        """
        start_warp()
        padded = zeros(PADDED_VOXELS, wp.float32, device)
        padded_jacobian = None if jacobian is None else zeros(PADDED_VOXELS, vec16, device)
        flags, cells = (zeros(PADDED_VOXELS, wp.uint8, device) for _ in range(2))
        launch(
            pad_kernel,
            dim=_VOXELS,
            inputs=[
                to_device(occupancy, wp.float32, device),
                None if jacobian is None else to_device(jacobian, vec16, device),
                int(jacobian is not None),
                float(skip_occupancy),
                float(skip_jacobian),
            ],
            outputs=[padded, padded_jacobian, flags],
            device=device,
        )
        launch(flag_cells_kernel, dim=_CELLS, inputs=[flags], outputs=[cells], device=device)
        return ShapeGrid(padded, padded_jacobian, cells, flags, device)

    def stepped(self, step: Float[np.ndarray, "16"]) -> ShapeGrid:
        """The grid after a small step of the code, with the Jacobian and the empty cells of this one.

        Log odds of occupancy are smooth in the code, so it is they that change linearly.
        """
        assert self.jacobian is not None
        occupancy = empty(PADDED_VOXELS, wp.float32, self.device)
        launch(
            step_kernel,
            dim=PADDED_VOXELS,
            inputs=[self.occupancy, self.jacobian, self.flags, vec16(*step.tolist())],
            outputs=[occupancy],
            device=self.device,
        )
        return replace(self, occupancy=occupancy)


@dataclass(frozen=True)
class _RayBuffers:
    """A ray bundle's arrays on one device, and room for the samples of every ray that is worked on."""

    directions: wp.array
    view: wp.array
    depth_range: wp.array
    stacks: tuple[wp.array, ...]


@dataclass(frozen=True)
class RayBundle:
    """Pixels of one or several views to be rendered: everything that stays the same over a fit.

    Rendered in one thread at a time: its arrays on the device, scratch space too, are kept between calls.

    Attributes:
        directions: (n, 3) back-projected pixels in their camera's frame, z = 1, so that depth scales them.
        view: (n,) index of each ray's camera.
        depth_range: (v, 2) nearest and farthest depth for each camera in [m].
        samples: M, the number of samples between the two.
        threads: how many cores share the rays, on the CPU; the result is the same.
    """

    directions: Float[np.ndarray, "n 3"]
    view: Int[np.ndarray, "n"]
    depth_range: Float[np.ndarray, "v 2"]
    samples: int
    threads: int = 1

    @cached_property
    def _buffers(self) -> dict[str, _RayBuffers]:
        return {}

    def on_device(self, device: str) -> _RayBuffers:
        """The rays on a device, brought there by the first call."""
        if device not in self._buffers:
            # rays of one thread come one after the other on the CPU: the same little room will do for all
            room = self.samples * (1 if device == "cpu" else len(self.directions))
            self._buffers[device] = _RayBuffers(
                directions=to_device(self.directions, wp.vec3, device),
                view=to_device(self.view, wp.int32, device),
                depth_range=to_device(self.depth_range, wp.vec2, device),
                stacks=tuple(
                    empty(room, wp.vec3, device) for _ in range(self.threads if device == "cpu" else 1)
                ),
            )
        return self._buffers[device]

    @property
    def escape_depth(self) -> Float[np.ndarray, "v"]:
        """Depth of rays that miss the object, by view in [m]."""
        return ESCAPE_FACTOR * self.depth_range[:, 1]


@dataclass(frozen=True)
class Rendering:
    """What the rays see, and how it changes.

    Attributes:
        depth: (n,) expected depth in [m].
        variance: (n,) its variance in [m^2].
        mask: (n,) probability to hit the object.
        d_code: (n, 16) derivative of depth by the code, or None.
        sum_gradient: (n, 3) sum of w_i grad o_i, by canonical coordinates, or None.
        sum_depth_gradient: (n, 3) sum of w_i delta_i grad o_i, or None.
    """

    depth: Float[np.ndarray, "n"]
    variance: Float[np.ndarray, "n"]
    mask: Float[np.ndarray, "n"]
    d_code: Float[np.ndarray, "n 16"] | None = None
    sum_gradient: Float[np.ndarray, "n 3"] | None = None
    sum_depth_gradient: Float[np.ndarray, "n 3"] | None = None


def render(
    shape: ShapeGrid,
    rays: RayBundle,
    A_canonical_camera: Float[np.ndarray, "v 3 4"],
    gradients: bool = True,
) -> Rendering:
    """Renders the shape along the rays.

    Args:
        shape: the grid on its device.
        rays: pixels and depth ranges.
        A_canonical_camera: affine maps from the cameras' frames to the canonical cube (see ``pose.py``).
        gradients: whether the Jacobian is wanted too.
    """
    n, device = len(rays.directions), shape.device
    on_device = rays.on_device(device)
    with_code = gradients and shape.jacobian is not None
    depth, variance, mask = (empty(n, dtype=wp.float32, device=device) for _ in range(3))
    sums = empty((n, 2) if gradients else (1, 2), dtype=wp.vec3, device=device)
    d_code = empty(n if with_code else 1, dtype=vec16, device=device)
    inputs = [
        shape.occupancy,
        shape.jacobian,
        shape.cells,
        on_device.directions,
        on_device.view,
        to_device(A_canonical_camera[:, :, :3], wp.mat33, device),
        to_device(A_canonical_camera[:, :, 3], wp.vec3, device),
        on_device.depth_range,
        rays.samples,
        int(gradients),
        int(with_code),
        0 if device == "cpu" else rays.samples,
    ]
    outputs = [depth, variance, mask, sums, d_code]
    parts = np.linspace(0, n, len(on_device.stacks) + 1).astype(int).tolist()

    def work(part: int) -> None:
        begin, end = parts[part], parts[part + 1]
        launch(
            render_kernel,
            dim=end - begin,
            inputs=[*inputs, begin, on_device.stacks[part]],
            outputs=outputs,
            device=device,
        )

    # The kernel lets go of Python's lock; the first part is done by this thread itself.
    others = [_pool().submit(work, part) for part in range(1, len(on_device.stacks))]
    work(0)
    for other in others:
        other.result()
    sums_host = sums.numpy() if gradients else None
    return Rendering(
        depth=depth.numpy(),
        variance=variance.numpy(),
        mask=mask.numpy(),
        d_code=d_code.numpy() if with_code else None,
        sum_gradient=None if sums_host is None else sums_host[:, 0],
        sum_depth_gradient=None if sums_host is None else sums_host[:, 1],
    )


@cache
def _pool() -> ThreadPoolExecutor:
    """Threads for parts of renderings."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="render")
