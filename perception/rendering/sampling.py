"""What every kernel does along a ray through the padded grid: where it is inside, occupancies and slopes.

Points are in voxels of the padded grid, whose corner voxel has its centre at 0; a cell between eight voxels
has the index of its lowest one. Warp functions: one source for CPU and CUDA, part of the kernels that use
them.
"""

from typing import no_type_check

import warp as wp

from perception.types import CODE_SIZE, GRID_RESOLUTION

PADDED_VOXELS = (GRID_RESOLUTION + 2) ** 3

# Inside the kernels the grid is flat, with a border of empty voxels, where interpolation fades out.
SIDE = wp.constant(GRID_RESOLUTION + 2)
SLAB = wp.constant((GRID_RESOLUTION + 2) ** 2)
HALF = wp.constant(GRID_RESOLUTION / 2.0)
_END = wp.constant(GRID_RESOLUTION + 1.0)
_MARGIN = wp.constant(1e-3)  # [voxel] keeps rounding from indexing outside

vec16 = wp.types.vector(length=CODE_SIZE, dtype=wp.float32)


@wp.func
@no_type_check  # for the run-time checker of the tests: these are Warp types
def in_voxels(canonical: wp.vec3) -> wp.vec3:
    """A point of the canonical cube, in voxels."""
    return HALF * canonical + wp.vec3(HALF + 0.5, HALF + 0.5, HALF + 0.5)


@wp.func
@no_type_check
def samples_inside(
    origin: wp.vec3, direction: wp.vec3, near: float, far: float, step: float, samples: int
) -> wp.vec2i:
    """First and last of the samples near + i step, i = 1 ... samples, in the grid; last < first for none."""
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
    """The same for the box from cell ``boxes[at]`` to cell ``boxes[at + 1]``."""
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
    """The same for the box between two corners; none are in one whose corners are the wrong way round."""
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
    first = wp.max(int(wp.ceil((enter - near) / step)), 1)
    last = wp.min(int(wp.floor((leave - near) / step)), samples)
    return wp.vec2i(first, last)


@wp.func
@no_type_check
def cell_of(p: wp.vec3) -> int:
    """Index of the cell that a point lies in."""
    return (int(p[0]) * SIDE + int(p[1])) * SIDE + int(p[2])


@wp.func
@no_type_check
def in_cell(p: wp.vec3) -> wp.vec3:
    """Where in its cell a point lies, 0..1 along each axis."""
    return p - wp.vec3(float(int(p[0])), float(int(p[1])), float(int(p[2])))


@wp.func
@no_type_check
def trilinear(occupancy: wp.array(dtype=wp.float32), at: int, f: wp.vec3) -> float:
    """Between the corners of the cell whose lowest voxel is the array's entry ``at``."""
    o00 = wp.lerp(occupancy[at], occupancy[at + 1], f[2])
    o01 = wp.lerp(occupancy[at + SIDE], occupancy[at + SIDE + 1], f[2])
    o10 = wp.lerp(occupancy[at + SLAB], occupancy[at + SLAB + 1], f[2])
    o11 = wp.lerp(occupancy[at + SLAB + SIDE], occupancy[at + SLAB + SIDE + 1], f[2])
    return wp.lerp(wp.lerp(o00, o01, f[1]), wp.lerp(o10, o11, f[1]), f[0])


@wp.func
@no_type_check
def slopes(occupancy: wp.array(dtype=wp.float32), at: int, f: wp.vec3) -> wp.vec3:
    """Gradient of ``trilinear`` with respect to the point, per voxel."""
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
def code_slopes(jacobian: wp.array(dtype=vec16), at: int, f: wp.vec3) -> vec16:
    """Derivative of ``trilinear`` with respect to the code, interpolated from the corners."""
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
