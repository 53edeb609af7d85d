# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Warp kernels of the probabilistic renderer (NodeSLAM, section "Probabilistic Rendering"), for CPU and CUDA.

One pass computes depth, variance, mask and the Jacobian. With the occupancy o_i at sample i, transmittance
T_i = prod_{j<i} (1 - o_j), and E_i the expected depth of a ray that reaches sample i,

    E_{M+1} = 1.1 delta_max,    E_i = o_i delta_i + (1 - o_i) E_{i+1},    D = E_1,
    dD/do_i = w_i = T_i (delta_i - E_{i+1}),

without division by 1 - o_i. The Jacobian is accumulated in three sums along the ray: w_i do_i/dcode (16,),
w_i grad o_i (3,) and w_i delta_i grad o_i (3,). The last two give the derivative with respect to the affine
map from the camera frame to the canonical cube; ``pose.py`` applies the chain rule to the 9-DoF pose.

Samples outside the occupied box, and in cells that are empty and insensitive to the code, are skipped.
"""

from typing import no_type_check

import warp as wp

from perception.rendering.sampling import (
    HALF,
    SIDE,
    SLAB,
    cell_fraction,
    cell_index,
    samples_in_box,
    trilinear,
    trilinear_gradient,
    trilinear_jacobian,
    vec16,
    voxel_from_canonical,
)
from perception.types import GRID_RESOLUTION

ESCAPE_FACTOR = 1.1  # escape depth as a multiple of the largest sample depth (paper, "Aggregation")
_ESCAPE = wp.constant(ESCAPE_FACTOR)
_MIN_TRANSMITTANCE = wp.constant(1e-5)  # threshold of early ray termination
_MIN_WEIGHT = wp.constant(3e-6)  # [m]; samples of smaller |dD/do_i| are left out of the Jacobian
# Bit flags: of voxels all three, of cells the first two.
_OCCUPIED = wp.constant(1)  # occupancy above ``skip_occupancy``
_SENSITIVE = wp.constant(2)  # derivative with respect to the code above ``skip_jacobian``
STEPPABLE = 4  # occupancy is updated by ``step_kernel``
_STEPPABLE = wp.constant(STEPPABLE)
_CLIP = wp.constant(1e-4)  # occupancies are clipped to [1e-4, 1 - 1e-4] before the logit
_MIN_SLOPE = wp.constant(1e-7)  # o (1 - o) up to which the sigmoid is saturated and the derivative zero
_MIN_STEPPABLE = wp.constant(1e-4)  # largest derivative up to which a voxel keeps its occupancy in steps

wp.set_module_options(
    {
        "enable_backward": False,  # derivatives are analytic
        "optimization_level": 3,
        "cpu_compiler_flags": "-march=native -ffp-contract=fast",  # fused multiply-add
    }
)

mat34 = wp.types.matrix(shape=(3, 4), dtype=wp.float32)


@wp.kernel
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
def pad_kernel(
    occupancy: wp.array3d(dtype=wp.float32),
    jacobian: wp.array3d(dtype=vec16),
    with_code: int,
    skip_occupancy: float,
    skip_jacobian: float,
    padded: wp.array(dtype=wp.float32),
    padded_jacobian: wp.array(dtype=vec16),
    flags: wp.array(dtype=wp.uint8),
):
    """Copy a grid and its Jacobian to the padded flat layout and set each voxel's flags.

    One thread for each column along z.
    """
    i, j = wp.tid()
    to = ((i + 1) * SIDE + j + 1) * SIDE
    for k in range(GRID_RESOLUTION):
        to += 1
        o = occupancy[i, j, k]
        padded[to] = o
        flag = int(0)
        if o > skip_occupancy:
            flag = flag | _OCCUPIED
        if with_code != 0 and o * (1.0 - o) > _MIN_SLOPE:
            row = jacobian[i, j, k]
            padded_jacobian[to] = row
            max_derivative = wp.max(wp.max(row), -wp.min(row))
            if max_derivative > skip_jacobian:
                flag = flag | _SENSITIVE
            if max_derivative > _MIN_STEPPABLE:
                flag = flag | _STEPPABLE
        flags[to] = wp.uint8(flag)


@wp.kernel
@no_type_check
def step_kernel(
    steppable: wp.array(dtype=wp.int32),
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    step: vec16,
    stepped: wp.array(dtype=wp.float32),
):
    """Update occupancies by a step of the code, linearly in their log odds: dlogit = do / (o (1 - o))."""
    at = steppable[wp.tid()]
    o = wp.clamp(occupancy[at], _CLIP, 1.0 - _CLIP)
    change = wp.dot(jacobian[at], step) / (o * (1.0 - o))
    stepped[at] = o / (o + (1.0 - o) * wp.exp(-wp.clamp(change, -30.0, 30.0)))


@wp.kernel
@no_type_check
def flag_cells_kernel(
    voxels: wp.array(dtype=wp.uint8), cells: wp.array(dtype=wp.uint8), box: wp.array(dtype=wp.vec3i)
):
    """Set each cell's flags to the union of its eight voxels' and extend the box by all flagged cells.

    One thread for each column of cells along z.
    """
    i, j = wp.tid()
    low = (i * SIDE + j) * SIDE
    below = int(0)
    first = int(SIDE)
    last = int(-1)
    for k in range(SIDE):
        at = low + k
        here = int(voxels[at]) | int(voxels[at + SIDE])
        here = (here | int(voxels[at + SLAB]) | int(voxels[at + SLAB + SIDE])) & (_OCCUPIED | _SENSITIVE)
        if k > 0:
            cells[at - 1] = wp.uint8(here | below)
            if (here | below) != 0:
                first = wp.min(first, k - 1)
                last = k - 1
        below = here
    if last >= 0:
        wp.atomic_min(box, 0, wp.vec3i(i, j, first))
        wp.atomic_max(box, 1, wp.vec3i(i, j, last))


@wp.kernel
@no_type_check
def render_kernel(
    directions: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.int32),
    depth_range: wp.array(dtype=wp.vec2),
    maps: wp.array(dtype=mat34),
    samples: int,
    stack_stride: int,
    begin: int,
    stack: wp.array(dtype=wp.vec3),
    gradients: int,
    with_code: int,
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    cells: wp.array(dtype=wp.uint8),
    box: wp.array(dtype=wp.vec3i),
    rows: wp.array2d(dtype=vec16),
):
    """Render the rays from ``begin`` on, one in each thread.

    ``stack_stride`` is ``samples``, or 0 if threads run one after the other and share one stack. The output
    rows are d depth / d code (16,), then d depth / d map (12,) by columns, depth, variance and mask.
    """
    ray = begin + wp.tid()
    stack_begin = wp.tid() * stack_stride
    view = views[ray]
    # The ray in voxel units of the padded grid, as a function of the depth.
    pixel = directions[ray]
    direction = HALF * (maps[view] * wp.vec4(pixel[0], pixel[1], pixel[2], 0.0))
    origin = voxel_from_canonical(maps[view] * wp.vec4(0.0, 0.0, 0.0, 1.0))
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_in_box(origin, direction, near, far, step, samples, box, 0)

    # Front to back: push depth, occupancy and transmittance of each sample in a flagged cell onto the stack.
    count = int(0)
    transmittance = float(1.0)
    terminal_depth = float(_ESCAPE * far)
    for i in range(inside[0], inside[1] + 1):
        delta = near + float(i) * step
        p = origin + delta * direction
        at = cell_index(p)
        if cells[at] != wp.uint8(0):
            o = trilinear(occupancy, at, cell_fraction(p))
            stack[stack_begin + count] = wp.vec3(delta, o, transmittance)
            count += 1
            transmittance = transmittance * (1.0 - o)
            if transmittance < _MIN_TRANSMITTANCE:
                terminal_depth = delta
                break

    # Back to front: E_i and E[depth^2], relative to the middle of the range to limit cancellation.
    mid_depth = 0.5 * (near + far)
    mean = terminal_depth - mid_depth
    square = mean * mean
    code = vec16()
    sum_gradient = wp.vec3()
    sum_depth_gradient = wp.vec3()
    min_weight = wp.where(gradients != 0, float(_MIN_WEIGHT), 1.0e9)
    for n in range(count):
        entry = stack[stack_begin + count - 1 - n]
        delta = entry[0]
        o = entry[1]
        weight = entry[2] * (delta - mid_depth - mean)
        mean = wp.lerp(mean, delta - mid_depth, o)
        square = wp.lerp(square, (delta - mid_depth) * (delta - mid_depth), o)
        if wp.abs(weight) > min_weight:
            p = origin + delta * direction
            at = cell_index(p)
            f = cell_fraction(p)
            slope = (weight * HALF) * trilinear_gradient(occupancy, at, f)
            sum_gradient += slope
            sum_depth_gradient += delta * slope
            if with_code != 0 and (int(cells[at]) & _SENSITIVE) != 0:
                code += weight * trilinear_jacobian(jacobian, at, f)
    image = vec16()
    if gradients != 0:
        for column in range(3):
            for axis in range(3):
                image[3 * column + axis] = pixel[column] * sum_depth_gradient[axis]
            image[9 + column] = sum_gradient[column]
    image[12] = mean + mid_depth
    image[13] = wp.where(count > 0, wp.max(square - mean * mean, 0.0), 0.0)
    image[14] = 1.0 - transmittance
    rows[ray, 0] = code
    rows[ray, 1] = image
