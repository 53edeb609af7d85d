"""Probabilistic renderer: host side of the fused kernels, arrays in and arrays out.

``reference.py`` is the plain version of the same equations (NodeSLAM, section "Probabilistic Rendering").
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
    NOT_STILL,
    flag_cells_kernel,
    mat34,
    pad_kernel,
    render_kernel,
    step_kernel,
)
from perception.rendering.sampling import PADDED_VOXELS, vec16
from perception.types import GRID_RESOLUTION
from perception.warp_runtime import empty, launch, record, run_recorded, start_warp, to_device, zeros

_COLUMNS = (GRID_RESOLUTION,) * 2
_CELL_COLUMNS = (GRID_RESOLUTION + 1,) * 2
_EMPTY_BOX = np.repeat([[GRID_RESOLUTION + 2], [-1]], 3, axis=1)


@dataclass(frozen=True)
class ShapeGrid:
    """An occupancy grid and, where wanted, its Jacobian with respect to the code, on one device.

    Attributes:
        occupancy: flat, with a border of empty voxels.
        jacobian: d occupancy / d code in the same layout, or None.
        cells: flags of the cells between eight voxels, by their lowest one; 0 where there is nothing to see.
        box: the lowest and the highest of these cells along each axis; nothing is to be seen outside.
        moving: indices of the voxels that steps of the code change, or None without a Jacobian.
        device: "cpu" or "cuda:0".
    """

    occupancy: wp.array
    jacobian: wp.array | None
    cells: wp.array
    box: wp.array
    moving: wp.array | None
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
            dim=_COLUMNS,
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
        moving = None
        if jacobian is not None:
            moving = to_device(np.flatnonzero(flags.numpy() & NOT_STILL), wp.int32, device)
        return ShapeGrid(padded, padded_jacobian, cells, box, moving, device)

    def stepped(self, step: Float[np.ndarray, "16"]) -> ShapeGrid:
        """The grid after a small step of the code, with the Jacobian and the empty cells of this one.

        Log odds of occupancy are smooth in the code, so it is they that change linearly.
        """
        assert self.jacobian is not None and self.moving is not None
        occupancy = wp.clone(self.occupancy)
        launch(
            step_kernel,
            dim=len(self.moving),
            inputs=[self.moving, self.occupancy, self.jacobian, vec16(*step.tolist())],
            outputs=[occupancy],
            device=self.device,
        )
        return replace(self, occupancy=occupancy)


@dataclass(frozen=True)
class _RayBuffers:
    """A ray bundle's arrays on one device, and its launches: one for each core that shares the rays.

    Attributes:
        maps: of the cameras, overwritten by every rendering.
        launches: of the render kernel, each with room for the samples of the rays it works on.
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
        # rays of one thread come one after the other on the CPU: the same little room will do for all
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


_CHANGING = 8  # position of the first of the render kernel's arguments that change with every rendering


@dataclass(frozen=True)
class RayBundle:
    """Pixels of one or several views to be rendered: everything that stays the same over a fit.

    Rendered in one thread at a time: its arrays on the device, scratch space too, are kept between calls.

    Attributes:
        directions: (n, 3) back-projected pixels in their camera's frame, z = 1, so that depth scales them.
        view: (n,) index of each ray's camera, one camera's rays after the other's.
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
            self._buffers[device] = _RayBuffers.of(self, device)
        return self._buffers[device]

    @cached_property
    def of_view(self) -> tuple[slice, ...]:
        """Which rays are each camera's."""
        ends = np.searchsorted(self.view, np.arange(len(self.depth_range) + 1)).tolist()
        return tuple(slice(begin, end) for begin, end in pairwise(ends))

    @property
    def escape_depth(self) -> Float[np.ndarray, "v"]:
        """Depth of rays that miss the object, by view in [m]."""
        return ESCAPE_FACTOR * self.depth_range[:, 1]


@dataclass(frozen=True)
class Rendering:
    """Rendered depth, variance and mask, with derivatives.

    Attributes:
        depth: (n,) expected depth in [m].
        variance: (n,) its variance in [m^2].
        mask: (n,) probability to hit the object.
        d_code: (n, 16) derivative of the depth with respect to the code, or None.
        d_map: (n, 12) derivative of the depth with respect to the ray's camera map by columns, or None.
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
        shape: the grid on its device.
        rays: pixels and depth ranges.
        A_canonical_camera: affine maps from the cameras' frames to the canonical cube (see ``pose.py``).
        gradients: whether the Jacobian is wanted too.
    """
    n, device = len(rays.directions), shape.device
    on_device = rays.on_device(device)
    with_code = gradients and shape.jacobian is not None
    on_device.maps.assign(np.ascontiguousarray(A_canonical_camera, np.float32))
    rows = empty((n, 2), dtype=vec16, device=device)
    changing = [int(gradients), int(with_code), shape.occupancy, shape.jacobian, shape.cells, shape.box, rows]
    arguments = dict(enumerate(changing, start=_CHANGING))
    run_recorded(on_device.launches, arguments)
    code, image = rows.numpy().swapaxes(0, 1)
    return Rendering(
        depth=image[:, 12],
        variance=image[:, 13],
        mask=image[:, 14],
        d_code=code if with_code else None,
        d_map=image[:, :12] if gradients else None,
    )
