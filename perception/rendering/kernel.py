# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""The kernels of the probabilistic renderer, in Warp: one source for CPU and CUDA.

Depth, variance, mask and the whole Jacobian in one pass. With o_i the occupancy at sample i, T_i the
probability to reach it and E_i the expected depth from there on,

    E_{M+1} = escape depth,    E_i = o_i delta_i + (1 - o_i) E_{i+1},    D = E_1,
    dD/do_i = w_i = T_i (delta_i - E_{i+1}),

without any division. The Jacobian then needs three sums along the ray: w_i do_i/dcode (16 numbers), and
w_i grad o_i and w_i delta_i grad o_i (3 each), which give the derivative with
respect to the affine map from the camera's points to the grid; ``pose.py`` applies the chain rule.

Samples outside the grid are never visited; those in cells where nothing is and which no code moves are
skipped.
"""

from typing import no_type_check

import warp as wp

from perception.rendering.sampling import (
    HALF,
    SIDE,
    SLAB,
    cell_of,
    code_slopes,
    in_cell,
    in_voxels,
    samples_in_box,
    slopes,
    trilinear,
    vec16,
)
from perception.types import GRID_RESOLUTION

ESCAPE_FACTOR = 1.1  # escape depth over the farthest sample's depth (paper, "Aggregation")
_ESCAPE = wp.constant(ESCAPE_FACTOR)
_OPAQUE = wp.constant(1e-5)  # a ray less likely than this to go on ends at the sample where it stands
_LEAST_WEIGHT = wp.constant(3e-6)  # [m] of depth by occupancy: less is no derivative worth its time
_OCCUPIED = wp.constant(1)  # flags of cells
_CODE_MOVES = wp.constant(2)
NOT_STILL = 4
_NOT_STILL = wp.constant(NOT_STILL)
_CLIP = wp.constant(1e-4)  # occupancies closer than this to 0 or 1 are taken to be so close
_FLAT = wp.constant(1e-7)  # o (1 - o) of a voxel that no code moves any more
_STILL = wp.constant(1e-4)  # voxels that no code moves faster than this stay as they are

wp.set_module_options(
    {
        "enable_backward": False,  # the derivatives are written out below
        "optimization_level": 3,
        "cpu_compiler_flags": "-march=native -ffp-contract=fast",  # fused multiply-add: a sixth faster
    }
)

mat34 = wp.types.matrix(shape=(3, 4), dtype=wp.float32)


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
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
    """A grid into the flat one with its border, and what is worth knowing about each voxel, by columns."""
    i, j = wp.tid()
    to = ((i + 1) * SIDE + j + 1) * SIDE
    for k in range(GRID_RESOLUTION):
        to += 1
        o = occupancy[i, j, k]
        padded[to] = o
        flag = int(0)
        if o > skip_occupancy:
            flag = flag | _OCCUPIED
        if with_code != 0 and o * (1.0 - o) > _FLAT:
            row = jacobian[i, j, k]
            padded_jacobian[to] = row
            fastest = wp.max(wp.max(row), -wp.min(row))
            if fastest > skip_jacobian:
                flag = flag | _CODE_MOVES
            if fastest > _STILL:
                flag = flag | _NOT_STILL
        flags[to] = wp.uint8(flag)


@wp.kernel
@no_type_check
def step_kernel(
    moving: wp.array(dtype=wp.int32),
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    step: vec16,
    stepped: wp.array(dtype=wp.float32),
):
    """Occupancies after a small step of the code, along which their log odds change linearly."""
    at = moving[wp.tid()]
    o = wp.clamp(occupancy[at], _CLIP, 1.0 - _CLIP)
    change = wp.dot(jacobian[at], step) / (o * (1.0 - o))
    stepped[at] = o / (o + (1.0 - o) * wp.exp(-wp.clamp(change, -30.0, 30.0)))


@wp.kernel
@no_type_check
def flag_cells_kernel(
    voxels: wp.array(dtype=wp.uint8), cells: wp.array(dtype=wp.uint8), box: wp.array(dtype=wp.vec3i)
):
    """What the eight voxels around a cell have between them; a cell has the index of its lowest voxel.

    A thread goes up one column of cells; the box comes to hold all that are worth a visit.
    """
    i, j = wp.tid()
    low = (i * SIDE + j) * SIDE
    below = int(0)
    first = int(SIDE)
    last = int(-1)
    for k in range(SIDE):
        at = low + k
        here = int(voxels[at]) | int(voxels[at + SIDE])
        here = (here | int(voxels[at + SLAB]) | int(voxels[at + SLAB + SIDE])) & (_OCCUPIED | _CODE_MOVES)
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
    """The rays from ``begin`` on, one in each thread.

    ``stack_stride`` is ``samples``; or 0 where one thread after the other may use the same room. A ray's row
    is its derivative by the code; then that by its camera's map, column after column, depth, variance, mask.
    """
    ray = begin + wp.tid()
    stack_begin = wp.tid() * stack_stride
    view = views[ray]
    # In voxels of the padded grid, whose corner voxel has its centre at 0.
    pixel = directions[ray]
    direction = HALF * (maps[view] * wp.vec4(pixel[0], pixel[1], pixel[2], 0.0))
    origin = in_voxels(maps[view] * wp.vec4(0.0, 0.0, 0.0, 1.0))
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_in_box(origin, direction, near, far, step, samples, box, 0)

    # Forwards: occupancy and the probability to get there, of the samples that matter, onto a stack.
    count = int(0)
    reaching = float(1.0)
    behind = float(_ESCAPE * far)
    for i in range(inside[0], inside[1] + 1):
        delta = near + float(i) * step
        p = origin + delta * direction
        at = cell_of(p)
        if cells[at] != wp.uint8(0):
            o = trilinear(occupancy, at, in_cell(p))
            stack[stack_begin + count] = wp.vec3(delta, o, reaching)
            count += 1
            reaching = reaching * (1.0 - o)
            if reaching < _OPAQUE:
                behind = delta
                break

    # Backwards: expected depth behind each sample; depths from the middle, so that squares stay small.
    middle = 0.5 * (near + far)
    mean = behind - middle
    square = mean * mean
    code = vec16()
    sum_gradient = wp.vec3()
    sum_depth_gradient = wp.vec3()
    wanted = wp.where(gradients != 0, float(_LEAST_WEIGHT), 1.0e9)
    for n in range(count):
        entry = stack[stack_begin + count - 1 - n]
        delta = entry[0]
        o = entry[1]
        weight = entry[2] * (delta - middle - mean)
        mean = wp.lerp(mean, delta - middle, o)
        square = wp.lerp(square, (delta - middle) * (delta - middle), o)
        if wp.abs(weight) > wanted:
            p = origin + delta * direction
            at = cell_of(p)
            f = in_cell(p)
            slope = (weight * HALF) * slopes(occupancy, at, f)
            sum_gradient += slope
            sum_depth_gradient += delta * slope
            if with_code != 0 and (int(cells[at]) & _CODE_MOVES) != 0:
                code += weight * code_slopes(jacobian, at, f)
    image = vec16()
    if gradients != 0:
        for column in range(3):
            for axis in range(3):
                image[3 * column + axis] = pixel[column] * sum_depth_gradient[axis]
            image[9 + column] = sum_gradient[column]
    image[12] = mean + middle
    image[13] = wp.where(count > 0, wp.max(square - mean * mean, 0.0), 0.0)
    image[14] = 1.0 - reaching
    rows[ray, 0] = code
    rows[ray, 1] = image
