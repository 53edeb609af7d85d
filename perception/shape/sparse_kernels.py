# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Warp kernels of the sparse decoder, for CPU and CUDA.

All layers are transposed convolutions of kernel 4, stride 2, padding 1: along each axis fine voxel f reads
the coarse voxels i = (f + 1) // 2 and i - 1 through the taps f + 1 - 2 i. Feature grids are flat in the order
[x, y, z]; every voxel has memory for all channels and stores its active ones (value above zero) compactly:
their count, indices, values and derivatives.

``begin`` is the first x index of a launch, so that several launches can share a layer.
"""

from __future__ import annotations

from typing import no_type_check

import warp as wp

from perception.types import CODE_SIZE

_BLOCK = wp.constant(16)  # output channels computed together
_MIN_SLOPE = wp.constant(1e-4)  # slope o (1 - o) of the sigmoid up to which derivatives count as zero

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
def neighbour_voxel(neighbour: int, x: int, y: int, z: int, side: int):
    """Return the index of one of the eight coarse voxels that a fine voxel reads, or -1 outside the grid.

    ``neighbour`` is 0..7, with the bits (x, y, z): a set bit selects the lower coarse voxel of the axis.
    """
    i = ((x + 1) >> 1) - (neighbour >> 2)
    j = ((y + 1) >> 1) - ((neighbour >> 1) & 1)
    k = ((z + 1) >> 1) - (neighbour & 1)
    if wp.min(wp.min(i, j), k) < 0 or wp.max(wp.max(i, j), k) >= side:
        return -1
    return (i * side + j) * side + k


@wp.func
@no_type_check
def corner_voxel(neighbour: int, x: int, y: int, z: int, side: int):
    """Return the index of one of the eight coarse voxels around a corner, or -1 outside the grid."""
    i = x - (neighbour >> 2)
    j = y - ((neighbour >> 1) & 1)
    k = z - (neighbour & 1)
    if wp.min(wp.min(i, j), k) < 0 or wp.max(wp.max(i, j), k) >= side:
        return -1
    return (i * side + j) * side + k


@wp.func
@no_type_check
def kernel_tap(neighbour: int, x: int, y: int, z: int):
    """Return the tap, 0..63 in the order [x, y, z], through which a fine voxel reads ``neighbour_voxel``."""
    tap_x = ((x + 1) & 1) + ((neighbour >> 2) << 1)
    tap_y = ((y + 1) & 1) + (neighbour & 2)
    tap_z = ((z + 1) & 1) + ((neighbour & 1) << 1)
    return (((tap_x << 2) + tap_y) << 2) + tap_z


@wp.kernel
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
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
    """Transposed convolution and ReLU; a thread computes all channels of one fine voxel.

    ``side`` is that of the coarse grid. ``weight[tap, input, block]`` holds 16 outputs; ``bias`` has one row
    for all voxels or one for each.
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
        neighbour = int(0)
        while neighbour < 8:
            source = neighbour_voxel(neighbour, x, y, z, side)
            if source >= 0:
                rows = kernel_tap(neighbour, x, y, z) * inputs
                n = int(source * inputs)
                end = n + in_count[source]
                while n < end:
                    total += in_value[n] * weight[(rows + in_channel[n]) * blocks + block]
                    n += 1
            neighbour += 1
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
    required: wp.array(dtype=wp.uint8),
    tangent: wp.array(dtype=vec16),
):
    """Derivatives d value / d code of the active channels of the ``required`` voxels.

    The ReLU mask is that of ``value_kernel``: only active channels are read and written. ``weight_by_output``
    is ordered [tap, output, input].
    """
    x, y, z = wp.tid()
    x += begin
    at = (x * 2 * side + y) * 2 * side + z
    if required[at] == wp.uint8(0):
        return
    m = int(at * outputs)
    found = m + count[at]
    while m < found:  # two outputs at a time halve the loads of the inputs
        other = wp.min(m + 1, found - 1)
        row = vec16()
        other_row = vec16()
        neighbour = int(0)
        while neighbour < 8:
            source = neighbour_voxel(neighbour, x, y, z, side)
            if source >= 0:
                rows = kernel_tap(neighbour, x, y, z) * outputs
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
            neighbour += 1
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
    required: wp.array(dtype=wp.uint8),
    occupancy: wp.array3d(dtype=wp.float32),
):
    """Transposed convolution to a single channel, and sigmoid.

    A thread computes the eight fine voxels around one corner between coarse voxels, since they read the same
    eight coarse voxels. ``weight[neighbour, input]`` holds the weights of the eight. ``required`` is set for
    corners with a slope of the sigmoid above ``_MIN_SLOPE``.
    """
    x, y, z = wp.tid()
    x += begin
    total = vec8()
    neighbour = int(0)
    while neighbour < 8:
        source = corner_voxel(neighbour, x, y, z, side)
        if source >= 0:
            n = int(source * inputs)
            end = n + in_count[source]
            while n < end:
                total += in_value[n] * weight[neighbour * inputs + in_channel[n]]
                n += 1
        neighbour += 1
    max_slope = float(0.0)
    for phase in range(8):
        fx = 2 * x - 1 + (phase >> 2)
        fy = 2 * y - 1 + ((phase >> 1) & 1)
        fz = 2 * z - 1 + (phase & 1)
        if wp.min(wp.min(fx, fy), fz) >= 0 and wp.max(wp.max(fx, fy), fz) < 2 * side:
            o = 1.0 / (1.0 + wp.exp(-total[phase] - bias))
            occupancy[fx, fy, fz] = o
            max_slope = wp.max(max_slope, o * (1.0 - o))
    required[(x * (side + 1) + y) * (side + 1) + z] = wp.uint8(max_slope > _MIN_SLOPE)


@wp.kernel
@no_type_check
def propagate_mask_kernel(
    stride: int,
    low: int,
    high: int,
    fine_side: int,
    side: int,
    fine: wp.array(dtype=wp.uint8),
    required: wp.array(dtype=wp.uint8),
):
    """Mark the coarse voxels read by any marked fine one: those at stride * i + low .. stride * i + high."""
    x, y, z = wp.tid()
    found = int(0)
    for i in range(wp.max(stride * x + low, 0), wp.min(stride * x + high + 1, fine_side)):
        for j in range(wp.max(stride * y + low, 0), wp.min(stride * y + high + 1, fine_side)):
            for k in range(wp.max(stride * z + low, 0), wp.min(stride * z + high + 1, fine_side)):
                found = found | int(fine[(i * fine_side + j) * fine_side + k])
    required[(x * side + y) * side + z] = wp.uint8(found)


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
    """Derivatives of the results of ``occupancy_kernel``; zero where the slope is at most ``_MIN_SLOPE``."""
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
            if slope > _MIN_SLOPE:
                neighbour = int(0)
                while neighbour < 8:
                    source = corner_voxel(neighbour, x, y, z, side)
                    if source >= 0:
                        n = int(source * inputs)
                        end = n + in_count[source]
                        while n < end:
                            row += (slope * weight[neighbour * inputs + in_channel[n]][phase]) * in_tangent[n]
                            n += 1
                    neighbour += 1
            jacobian[fx, fy, fz] = row
