"""Probabilistic renderer (NodeSLAM, section "Probabilistic Rendering"): host side of the Warp kernels.

``reference.py`` implements the same equations without the kernels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float, Int

from perception.rendering.kernel import (
    ESCAPE_FACTOR,
    STEPPABLE,
    flag_cells_kernel,
    mat34,
    pad_kernel,
    render_kernel,
    step_kernel,
)
from perception.rendering.sampling import PADDED_VOXELS, vec16
from perception.types import GRID_RESOLUTION
from perception.warp_runtime import empty, launch, record, run_recorded, start_warp, to_device, zeros

_VOXEL_COLUMNS = (GRID_RESOLUTION,) * 2
_CELL_COLUMNS = (GRID_RESOLUTION + 1,) * 2
_EMPTY_BOX = np.repeat([[GRID_RESOLUTION + 2], [-1]], 3, axis=1)


@dataclass(frozen=True)
class ShapeGrid:
    """An occupancy grid, optionally with its Jacobian with respect to the code, on one device.

    Attributes:
        occupancy: (34^3,) float32 occupancies, flat, with a border of empty voxels.
        jacobian: (34^3,) 16-vectors d occupancy / d code in the same layout, or None.
        cells: (34^3,) uint8 flags of the cells, see ``kernel.py``; cells with flags 0 are skipped.
        box: (2,) smallest and largest indices of the flagged cells along each axis.
        steppable: Indices of the voxels that ``stepped`` updates, or None without a Jacobian.
        device: "cpu" or "cuda:0".
    """

    occupancy: wp.array
    jacobian: wp.array | None
    cells: wp.array
    box: wp.array
    steppable: wp.array | None
    device: str

    @staticmethod
    def upload(
        occupancy: Float[np.ndarray, "r r r"],
        jacobian: Float[np.ndarray, "r r r 16"] | None = None,
        device: str = "cpu",
        skip_occupancy: float = 0.0,
        skip_jacobian: float = 0.0,
    ) -> ShapeGrid:
        """Upload a grid and flag the cells to be sampled.

        Args:
            occupancy: Occupancy probabilities G[ix, iy, iz].
            jacobian: Derivative d occupancy / d code.
            device: "cpu" or "cuda:0".
            skip_occupancy: Cells whose corners are all at or below this occupancy count as empty.
            skip_jacobian: Cells whose derivatives are all at or below this count as insensitive to the code.
        """
        start_warp()
        padded = zeros(PADDED_VOXELS, wp.float32, device)
        padded_jacobian = None if jacobian is None else zeros(PADDED_VOXELS, vec16, device)
        flags, cells = (zeros(PADDED_VOXELS, wp.uint8, device) for _ in range(2))
        launch(
            pad_kernel,
            dim=_VOXEL_COLUMNS,
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
        box = to_device(_EMPTY_BOX.copy(), wp.vec3i, device)
        launch(flag_cells_kernel, dim=_CELL_COLUMNS, inputs=[flags], outputs=[cells, box], device=device)
        steppable = None
        if jacobian is not None:
            steppable = to_device(np.flatnonzero(flags.numpy() & STEPPABLE), wp.int32, device)
        return ShapeGrid(padded, padded_jacobian, cells, box, steppable, device)

    def stepped(self, step: Float[np.ndarray, "16"]) -> ShapeGrid:
        """Return the grid after a small step of the code, linearised in the log odds of occupancy.

        Jacobian and flags of the cells are kept.
        """
        assert self.jacobian is not None and self.steppable is not None
        occupancy = wp.clone(self.occupancy)
        launch(
            step_kernel,
            dim=len(self.steppable),
            inputs=[self.steppable, self.occupancy, self.jacobian, vec16(*step.tolist())],
            outputs=[occupancy],
            device=self.device,
        )
        return replace(self, occupancy=occupancy)


@dataclass(frozen=True)
class _RayBuffers:
    """A ray bundle's arrays on one device, and recorded launches of the render kernel, one for each thread.

    Attributes:
        directions: (n,) ray directions.
        view: (n,) camera index of each ray.
        depth_range: (v,) depth ranges.
        maps: (v,) affine maps of the cameras, overwritten by every rendering.
        launches: Recorded launches, each with its own sample stack.
    """

    directions: wp.array
    view: wp.array
    depth_range: wp.array
    maps: wp.array
    launches: tuple[Any, ...]

    @staticmethod
    def of(rays: RayBundle, device: str) -> _RayBuffers:
        n = len(rays.directions)
        directions = to_device(rays.directions, wp.vec3, device)
        view = to_device(rays.view, wp.int32, device)
        depth_range = to_device(rays.depth_range, wp.vec2, device)
        maps = empty(len(rays.depth_range), mat34, device)
        on_cpu = device == "cpu"
        parts = np.linspace(0, n, (rays.threads if on_cpu else 1) + 1).astype(int).tolist()
        # A CPU thread renders its rays one after the other, so they share one sample stack.
        launches = tuple(
            record(
                render_kernel,
                end - begin,
                [
                    *(directions, view, depth_range, maps),
                    *(rays.samples, 0 if on_cpu else rays.samples, begin),
                    empty(rays.samples * (1 if on_cpu else n), wp.vec3, device),
                    *(0, 0, None, None, None, None),
                ],
                [empty((1, 2), vec16, device)],
                device,
            )
            for begin, end in pairwise(parts)
            if end > begin  # without rays there is no launch to record
        )
        return _RayBuffers(directions, view, depth_range, maps, launches)


_FIRST_CHANGING_ARGUMENT = (
    8  # position of the first of the render kernel's arguments that change with every rendering
)


@dataclass(frozen=True)
class RayBundle:
    """Rays of the pixels of one or several views; constant over a fit.

    Not thread-safe: device arrays, including scratch space, are kept between renderings.

    Attributes:
        directions: (n, 3) back-projected pixels in the camera frame, z = 1: points are depth * direction.
        view: (n,) camera index of each ray, in ascending order.
        depth_range: (v, 2) smallest and largest sample depth of each camera in [m].
        samples: Number of samples M of a ray: delta_i = delta_min + i / M (delta_max - delta_min).
        threads: Number of cores that share the rays on the CPU; the result does not depend on it.
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
        """Return the arrays and launches on a device, uploaded by the first call."""
        if device not in self._buffers:
            self._buffers[device] = _RayBuffers.of(self, device)
        return self._buffers[device]

    @cached_property
    def view_slices(self) -> tuple[slice, ...]:
        """Slices of the rays of each camera."""
        ends = np.searchsorted(self.view, np.arange(len(self.depth_range) + 1)).tolist()
        return tuple(slice(begin, end) for begin, end in pairwise(ends))

    @property
    def escape_depth(self) -> Float[np.ndarray, "v"]:
        """Rendered depth of rays that miss the object, for each camera, in [m]."""
        return ESCAPE_FACTOR * self.depth_range[:, 1]


@dataclass(frozen=True)
class Rendering:
    """Rendered depth, variance and mask, with derivatives.

    Attributes:
        depth: (n,) expected depth in [m].
        variance: (n,) variance of the depth in [m^2].
        mask: (n,) probability that the ray hits the object.
        d_code: (n, 16) derivative of the depth with respect to the code, or None.
        d_map: (n, 12) derivative of the depth with respect to the affine map of the ray's camera, by columns,
            or None.
    """

    depth: Float[np.ndarray, "n"]
    variance: Float[np.ndarray, "n"]
    mask: Float[np.ndarray, "n"]
    d_code: Float[np.ndarray, "n 16"] | None = None
    d_map: Float[np.ndarray, "n 12"] | None = None


def render(
    shape: ShapeGrid,
    rays: RayBundle,
    A_canonical_camera: Float[np.ndarray, "v 3 4"],
    gradients: bool = True,
) -> Rendering:
    """Render the shape along the rays.

    Args:
        shape: Occupancy grid.
        rays: Rays and depth ranges.
        A_canonical_camera: Affine maps from the camera frames to the canonical cube (see ``pose.py``).
        gradients: Whether to compute the derivatives; d_code needs the grid's Jacobian.
    """
    n, device = len(rays.directions), shape.device
    on_device = rays.on_device(device)
    with_code = gradients and shape.jacobian is not None
    on_device.maps.assign(np.ascontiguousarray(A_canonical_camera, np.float32))
    rows = empty((n, 2), dtype=vec16, device=device)
    changing = [int(gradients), int(with_code), shape.occupancy, shape.jacobian, shape.cells, shape.box, rows]
    arguments = dict(enumerate(changing, start=_FIRST_CHANGING_ARGUMENT))
    run_recorded(on_device.launches, arguments)
    code, image = rows.numpy().swapaxes(0, 1)
    return Rendering(
        depth=image[:, 12],
        variance=image[:, 13],
        mask=image[:, 14],
        d_code=code if with_code else None,
        d_map=image[:, :12] if gradients else None,
    )
