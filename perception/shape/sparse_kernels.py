# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""The kernels of the sparse decoder, in Warp: one source for CPU and CUDA.

All layers are transposed convolutions of kernel 4, stride 2, padding 1: along each axis fine voxel f takes
the coarse voxels i = (f + 1) // 2 and i - 1 through the taps f + 1 - 2 i. Grids are flat; every voxel has
room for all channels and lists those that are open: how many, which, their values and derivatives.

Threads have their voxels from ``begin`` on along x, so that several launches can share a layer.
"""

from __future__ import annotations

from typing import no_type_check

import warp as wp

from perception.types import CODE_SIZE

_BLOCK = wp.constant(16)  # output channels whose values are computed together
_FLAT = wp.constant(1e-4)  # slope of the sigmoid below which a voxel is taken not to move

wp.set_module_options(
    {
        "enable_backward": False,
        "optimization_level": 3,
        "cpu_compiler_flags": "-march=native -ffp-contract=fast",
    }
)

vec8 = wp.types.vector(length=8, dtype=wp.float32)
vec16 = wp.types.vector(length=CODE_SIZE, dtype=wp.float32)


@wp.func
@no_type_check
def source_of(near: int, x: int, y: int, z: int, side: int):
    """Index of one of the eight coarse voxels that a fine voxel takes from, or -1 outside the grid."""
    i = ((x + 1) >> 1) - (near >> 2)
    j = ((y + 1) >> 1) - ((near >> 1) & 1)
    k = ((z + 1) >> 1) - (near & 1)
    if wp.min(wp.min(i, j), k) < 0 or wp.max(wp.max(i, j), k) >= side:
        return -1
    return (i * side + j) * side + k


@wp.func
@no_type_check
def beside_corner(near: int, x: int, y: int, z: int, side: int):
    """Index of one of the eight coarse voxels around a corner, or -1 outside the grid."""
    i = x - (near >> 2)
    j = y - ((near >> 1) & 1)
    k = z - (near & 1)
    if wp.min(wp.min(i, j), k) < 0 or wp.max(wp.max(i, j), k) >= side:
        return -1
    return (i * side + j) * side + k


@wp.func
@no_type_check
def tap_of(near: int, x: int, y: int, z: int):
    """The kernel's tap through which it does."""
    tap_x = ((x + 1) & 1) + ((near >> 2) << 1)
    tap_y = ((y + 1) & 1) + (near & 2)
    tap_z = ((z + 1) & 1) + ((near & 1) << 1)
    return (((tap_x << 2) + tap_y) << 2) + tap_z


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
def value_kernel(
    begin: int,
    side: int,
    inputs: int,
    outputs: int,
    weight: wp.array(dtype=vec16),
    bias: wp.array(dtype=vec16),
    bias_rows: int,
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_value: wp.array(dtype=wp.float32),
    count: wp.array(dtype=wp.int32),
    channel: wp.array(dtype=wp.int32),
    value: wp.array(dtype=wp.float32),
):
    """One transposed convolution and ReLU; a thread computes all channels of one fine voxel.

    ``side`` is the coarse grid's. ``weight[tap, input, block]`` holds 16 outputs; ``bias`` has a row for all
    voxels, or one for each.
    """
    x, y, z = wp.tid()
    x += begin
    at = (x * 2 * side + y) * 2 * side + z
    blocks = outputs >> 4
    first = at * outputs
    found = int(first)
    block = int(0)
    while block < blocks:
        total = bias[(at % bias_rows) * blocks + block]
        near = int(0)
        while near < 8:
            source = source_of(near, x, y, z, side)
            if source >= 0:
                rows = tap_of(near, x, y, z) * inputs
                n = int(source * inputs)
                end = n + in_count[source]
                while n < end:
                    total += in_value[n] * weight[(rows + in_channel[n]) * blocks + block]
                    n += 1
            near += 1
        for c in range(_BLOCK):
            if total[c] > 0.0:
                channel[found] = block * _BLOCK + c
                value[found] = total[c]
                found += 1
        block += 1
    count[at] = found - first


@wp.kernel
@no_type_check
def tangent_kernel(
    begin: int,
    side: int,
    inputs: int,
    outputs: int,
    weight_by_output: wp.array(dtype=wp.float32),
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_tangent: wp.array(dtype=vec16),
    count: wp.array(dtype=wp.int32),
    channel: wp.array(dtype=wp.int32),
    wanted: wp.array(dtype=wp.uint8),
    tangent: wp.array(dtype=vec16),
):
    """The derivatives of the open channels of the voxels that are ``wanted``.

    ``weight_by_output`` is ordered [tap, output, input].
    """
    x, y, z = wp.tid()
    x += begin
    at = (x * 2 * side + y) * 2 * side + z
    if wanted[at] == wp.uint8(0):
        return
    m = int(at * outputs)
    found = m + count[at]
    while m < found:  # two outputs at a time: half the loads
        other = wp.min(m + 1, found - 1)
        row = vec16()
        other_row = vec16()
        near = int(0)
        while near < 8:
            source = source_of(near, x, y, z, side)
            if source >= 0:
                rows = tap_of(near, x, y, z) * outputs
                weights = (rows + channel[m]) * inputs
                other_weights = (rows + channel[other]) * inputs
                n = int(source * inputs)
                end = n + in_count[source]
                while n < end:
                    c = in_channel[n]
                    t = in_tangent[n]
                    row += weight_by_output[weights + c] * t
                    other_row += weight_by_output[other_weights + c] * t
                    n += 1
            near += 1
        tangent[m] = row
        tangent[other] = other_row
        m += 2


@wp.kernel
@no_type_check
def occupancy_kernel(
    begin: int,
    side: int,
    inputs: int,
    weight: wp.array(dtype=vec8),
    bias: float,
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_value: wp.array(dtype=wp.float32),
    wanted: wp.array(dtype=wp.uint8),
    occupancy: wp.array3d(dtype=wp.float32),
):
    """The transposed convolution to a single channel, and the sigmoid.

    A thread computes the eight fine voxels around one corner between coarse voxels: they take from the same
    eight of them. ``weight[near, input]`` holds what goes to the eight. ``wanted`` says of each corner
    whether any of its voxels can move.
    """
    x, y, z = wp.tid()
    x += begin
    total = vec8()
    near = int(0)
    while near < 8:
        source = beside_corner(near, x, y, z, side)
        if source >= 0:
            n = int(source * inputs)
            end = n + in_count[source]
            while n < end:
                total += in_value[n] * weight[near * inputs + in_channel[n]]
                n += 1
        near += 1
    steepest = float(0.0)
    for phase in range(8):
        fx = 2 * x - 1 + (phase >> 2)
        fy = 2 * y - 1 + ((phase >> 1) & 1)
        fz = 2 * z - 1 + (phase & 1)
        if wp.min(wp.min(fx, fy), fz) >= 0 and wp.max(wp.max(fx, fy), fz) < 2 * side:
            o = 1.0 / (1.0 + wp.exp(-total[phase] - bias))
            occupancy[fx, fy, fz] = o
            steepest = wp.max(steepest, o * (1.0 - o))
    wanted[(x * (side + 1) + y) * (side + 1) + z] = wp.uint8(steepest > _FLAT)


@wp.kernel
@no_type_check
def wanted_kernel(
    stride: int,
    low: int,
    high: int,
    fine_side: int,
    side: int,
    fine: wp.array(dtype=wp.uint8),
    wanted: wp.array(dtype=wp.uint8),
):
    """A coarse voxel i is wanted if any of the fine ones that take from it is: stride i + low to + high."""
    x, y, z = wp.tid()
    found = int(0)
    for i in range(wp.max(stride * x + low, 0), wp.min(stride * x + high + 1, fine_side)):
        for j in range(wp.max(stride * y + low, 0), wp.min(stride * y + high + 1, fine_side)):
            for k in range(wp.max(stride * z + low, 0), wp.min(stride * z + high + 1, fine_side)):
                found = found | int(fine[(i * fine_side + j) * fine_side + k])
    wanted[(x * side + y) * side + z] = wp.uint8(found)


@wp.kernel
@no_type_check
def jacobian_kernel(
    begin: int,
    side: int,
    inputs: int,
    weight: wp.array(dtype=vec8),
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_tangent: wp.array(dtype=vec16),
    occupancy: wp.array3d(dtype=wp.float32),
    jacobian: wp.array3d(dtype=vec16),
):
    """Derivatives of ``occupancy_kernel``'s results; zero where the sigmoid is flat."""
    x, y, z = wp.tid()
    x += begin
    for phase in range(8):
        fx = 2 * x - 1 + (phase >> 2)
        fy = 2 * y - 1 + ((phase >> 1) & 1)
        fz = 2 * z - 1 + (phase & 1)
        if wp.min(wp.min(fx, fy), fz) >= 0 and wp.max(wp.max(fx, fy), fz) < 2 * side:
            o = occupancy[fx, fy, fz]
            slope = o * (1.0 - o)
            row = vec16()
            if slope > _FLAT:
                near = int(0)
                while near < 8:
                    source = beside_corner(near, x, y, z, side)
                    if source >= 0:
                        n = int(source * inputs)
                        end = n + in_count[source]
                        while n < end:
                            row += (slope * weight[near * inputs + in_channel[n]][phase]) * in_tangent[n]
                            n += 1
                    near += 1
            jacobian[fx, fy, fz] = row
