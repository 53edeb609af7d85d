"""Warp functions of all rendering kernels: ray clipping, trilinear interpolation and its derivatives.

The grid is padded by one empty voxel on each side and stored flat in the order [x, y, z]. Points are in voxel
units of the padded grid: voxel (i, j, k) has its centre at (i, j, k). A cell is the cube between eight voxel
centres; its index is that of its lowest voxel.
"""

from typing import no_type_check

import warp as wp

from perception.types import CODE_SIZE, GRID_RESOLUTION

PADDED_VOXELS = (GRID_RESOLUTION + 2) ** 3

SIDE = wp.constant(GRID_RESOLUTION + 2)  # voxels along each axis of the padded grid; stride of y
SLAB = wp.constant((GRID_RESOLUTION + 2) ** 2)  # voxels of a slab of constant x; stride of x
HALF = wp.constant(GRID_RESOLUTION / 2.0)  # voxels in a canonical unit
_END = wp.constant(GRID_RESOLUTION + 1.0)  # coordinate of the last voxel centre
_MARGIN = wp.constant(1e-3)  # [voxel]; keeps rounding errors from indexing outside the grid

vec16 = wp.types.vector(length=CODE_SIZE, dtype=wp.float32)


@wp.func
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
def voxel_from_canonical(canonical: wp.vec3) -> wp.vec3:
    """Convert a point of the canonical cube [-1, 1]^3 to voxel units."""
    return HALF * canonical + wp.vec3(HALF + 0.5, HALF + 0.5, HALF + 0.5)


@wp.func
@no_type_check
def samples_in_grid(
    origin: wp.vec3, direction: wp.vec3, near: float, far: float, step: float, samples: int
) -> wp.vec2i:
    """Return the first and last index i of the samples inside the grid; last < first if there are none.

    The samples lie at the depths near + i * step, i = 1..samples, of the ray origin + depth * direction.
    """
    low = wp.vec3(_MARGIN, _MARGIN, _MARGIN)
    high = wp.vec3(_END - _MARGIN, _END - _MARGIN, _END - _MARGIN)
    return samples_between(origin, direction, near, far, step, samples, low, high)


@wp.func
@no_type_check
def samples_in_box(
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    far: float,
    step: float,
    samples: int,
    boxes: wp.array(dtype=wp.vec3i),
    at: int,
) -> wp.vec2i:
    """Return the first and last index of the samples inside the cells ``boxes[at]`` to ``boxes[at + 1]``."""
    low = wp.vec3(boxes[at])
    high = wp.vec3(boxes[at + 1] + wp.vec3i(1, 1, 1))
    low = wp.max(low, wp.vec3(_MARGIN, _MARGIN, _MARGIN))
    high = wp.min(high, wp.vec3(_END - _MARGIN, _END - _MARGIN, _END - _MARGIN))
    return samples_between(origin, direction, near, far, step, samples, low, high)


@wp.func
@no_type_check
def samples_between(
    origin: wp.vec3,
    direction: wp.vec3,
    near: float,
    far: float,
    step: float,
    samples: int,
    low: wp.vec3,
    high: wp.vec3,
) -> wp.vec2i:
    """Return the first and last index of the samples between two corners, by the slab method.

    A box with low > high along an axis is empty. A ray that is nearly parallel to a face reaches it, if at
    all, at a depth whose index is no int32, and one that is not finite has no samples.
    """
    enter = near
    leave = far
    for axis in range(3):
        d = direction[axis]
        if low[axis] > high[axis]:
            leave = near - 1.0
        elif wp.abs(d) > 1.0e-9:
            a = (low[axis] - origin[axis]) / d
            b = (high[axis] - origin[axis]) / d
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
        elif origin[axis] < low[axis] or origin[axis] > high[axis]:
            leave = near - 1.0
    if not (wp.isfinite(origin) and wp.isfinite(direction) and enter <= leave):
        return wp.vec2i(1, 0)
    first = wp.max(int(wp.ceil((enter - near) / step)), 1)
    last = wp.min(int(wp.floor((leave - near) / step)), samples)
    return wp.vec2i(first, last)


@wp.func
@no_type_check
def cell_index(p: wp.vec3) -> int:
    """Return the index of the cell that contains a point."""
    return (int(p[0]) * SIDE + int(p[1])) * SIDE + int(p[2])


@wp.func
@no_type_check
def cell_fraction(p: wp.vec3) -> wp.vec3:
    """Return the position of a point within its cell, 0..1 along each axis."""
    return p - wp.vec3(float(int(p[0])), float(int(p[1])), float(int(p[2])))


@wp.func
@no_type_check
def trilinear(occupancy: wp.array(dtype=wp.float32), at: int, f: wp.vec3) -> float:
    """Interpolate the occupancy at position ``f`` of the cell ``at``."""
    o00 = wp.lerp(occupancy[at], occupancy[at + 1], f[2])
    o01 = wp.lerp(occupancy[at + SIDE], occupancy[at + SIDE + 1], f[2])
    o10 = wp.lerp(occupancy[at + SLAB], occupancy[at + SLAB + 1], f[2])
    o11 = wp.lerp(occupancy[at + SLAB + SIDE], occupancy[at + SLAB + SIDE + 1], f[2])
    return wp.lerp(wp.lerp(o00, o01, f[1]), wp.lerp(o10, o11, f[1]), f[0])


@wp.func
@no_type_check
def trilinear_gradient(occupancy: wp.array(dtype=wp.float32), at: int, f: wp.vec3) -> wp.vec3:
    """Return the gradient of ``trilinear`` with respect to the point, in 1/voxel."""
    o000 = occupancy[at]
    o001 = occupancy[at + 1]
    o010 = occupancy[at + SIDE]
    o011 = occupancy[at + SIDE + 1]
    o100 = occupancy[at + SLAB]
    o101 = occupancy[at + SLAB + 1]
    o110 = occupancy[at + SLAB + SIDE]
    o111 = occupancy[at + SLAB + SIDE + 1]
    o00 = wp.lerp(o000, o001, f[2])
    o01 = wp.lerp(o010, o011, f[2])
    o10 = wp.lerp(o100, o101, f[2])
    o11 = wp.lerp(o110, o111, f[2])
    low = wp.lerp(o001 - o000, o011 - o010, f[1])
    high = wp.lerp(o101 - o100, o111 - o110, f[1])
    return wp.vec3(
        wp.lerp(o10, o11, f[1]) - wp.lerp(o00, o01, f[1]),
        wp.lerp(o01, o11, f[0]) - wp.lerp(o00, o10, f[0]),
        wp.lerp(low, high, f[0]),
    )


@wp.func
@no_type_check
def trilinear_jacobian(jacobian: wp.array(dtype=vec16), at: int, f: wp.vec3) -> vec16:
    """Interpolate d occupancy / d code at position ``f`` of the cell ``at``."""
    x0 = 1.0 - f[0]
    y0 = 1.0 - f[1]
    z0 = 1.0 - f[2]
    total = (x0 * y0 * z0) * jacobian[at]
    total += (x0 * y0 * f[2]) * jacobian[at + 1]
    total += (x0 * f[1] * z0) * jacobian[at + SIDE]
    total += (x0 * f[1] * f[2]) * jacobian[at + SIDE + 1]
    total += (f[0] * y0 * z0) * jacobian[at + SLAB]
    total += (f[0] * y0 * f[2]) * jacobian[at + SLAB + 1]
    total += (f[0] * f[1] * z0) * jacobian[at + SLAB + SIDE]
    total += (f[0] * f[1] * f[2]) * jacobian[at + SLAB + SIDE + 1]
    return total
