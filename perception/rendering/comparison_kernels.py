# ruff: noqa: UP018  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Kernels of the two renderers that the probabilistic one is compared with, in Warp, for CPU and CUDA.

Both walk the rays as ``kernel.render_kernel`` does and leave the same three sums behind, with other weights
w_i = d image / d o_i:

first crossing   the depth where occupancy first reaches a level. On the level set o(g(D, theta), theta) stays
                 constant, so dD/dtheta = -(do/dtheta) / (do/dD): one sample, of weight -1 / (do/dD).
silhouette       a sheet of cardboard at depth 0 before a backdrop at depth L: S = L prod_i (1 - o_i),
                 w_i = -L prod_{j != i} (1 - o_j).
"""

from typing import no_type_check

import warp as wp

from perception.rendering.kernel import ESCAPE_FACTOR
from perception.rendering.sampling import (
    HALF,
    cell_of,
    code_slopes,
    in_cell,
    in_voxels,
    samples_inside,
    slopes,
    trilinear,
    vec16,
)

_ESCAPE = wp.constant(ESCAPE_FACTOR)
_SECANT_STEPS = wp.constant(8)
_LEAST_SLOPE = wp.constant(0.02)  # [1/voxel] of occupancy along the ray: grazing hits get no endless weight
_OPAQUE = wp.constant(0.9999)  # occupancies are cut off here, so that one can be divided out of a product

wp.set_module_options({"enable_backward": False, "optimization_level": 3})


@wp.func
@no_type_check
def occupancy_at(occupancy: wp.array(dtype=wp.float32), p: wp.vec3) -> float:
    """At a point in voxels."""
    return trilinear(occupancy, cell_of(p), in_cell(p))


@wp.func
@no_type_check
def add_sample(
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    p: wp.vec3,
    weight: float,
    delta: float,
    with_code: int,
    ray: int,
    sums: wp.array2d(dtype=wp.vec3),
    d_code: wp.array(dtype=vec16),
):
    """Adds one sample's w grad o, w delta grad o (canonical coordinates) and w do/dcode to its ray's sums."""
    at = cell_of(p)
    slope = (weight * HALF) * slopes(occupancy, at, in_cell(p))
    sums[ray, 0] = sums[ray, 0] + slope
    sums[ray, 1] = sums[ray, 1] + delta * slope
    if with_code != 0:
        d_code[ray] = d_code[ray] + weight * code_slopes(jacobian, at, in_cell(p))


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
def first_crossing_kernel(
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    directions: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.int32),
    rotations: wp.array(dtype=wp.mat33),
    origins: wp.array(dtype=wp.vec3),
    depth_range: wp.array(dtype=wp.vec2),
    samples: int,
    level: float,
    gradients: int,
    with_code: int,
    depth: wp.array(dtype=wp.float32),
    mask: wp.array(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.vec3),
    d_code: wp.array(dtype=vec16),
):
    ray = wp.tid()
    view = views[ray]
    direction = HALF * (rotations[view] * directions[ray])
    origin = in_voxels(origins[view])
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_inside(origin, direction, near, far, step, samples)
    depth[ray] = _ESCAPE * far
    before = float(0.0)
    low = float(-1.0)
    for i in range(inside[0], inside[1] + 1):
        delta = near + float(i) * step
        o = occupancy_at(occupancy, origin + delta * direction)
        if o >= level and before < level and i > inside[0]:
            low = delta - step
            break
        before = o
    if low >= 0.0:
        high = low + step
        o_low = occupancy_at(occupancy, origin + low * direction)
        o_high = occupancy_at(occupancy, origin + high * direction)
        delta = high
        for _ in range(_SECANT_STEPS):
            delta = low + (level - o_low) / wp.max(o_high - o_low, 1.0e-6) * (high - low)
            o = occupancy_at(occupancy, origin + delta * direction)
            if o < level:
                low = delta
                o_low = o
            else:
                high = delta
                o_high = o
        depth[ray] = delta
        mask[ray] = 1.0
        if gradients != 0:
            p = origin + delta * direction
            width = 0.05 / wp.length(direction)  # a twentieth of a voxel to each side
            rise = occupancy_at(occupancy, p + width * direction) - occupancy_at(
                occupancy, p - width * direction
            )
            slope = rise / (2.0 * width)
            weight = -1.0 / wp.max(slope, _LEAST_SLOPE * wp.length(direction))
            add_sample(occupancy, jacobian, p, weight, delta, with_code, ray, sums, d_code)


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
def silhouette_kernel(
    occupancy: wp.array(dtype=wp.float32),
    jacobian: wp.array(dtype=vec16),
    directions: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.int32),
    rotations: wp.array(dtype=wp.mat33),
    origins: wp.array(dtype=wp.vec3),
    depth_range: wp.array(dtype=wp.vec2),
    samples: int,
    backdrop: float,
    gradients: int,
    with_code: int,
    depth: wp.array(dtype=wp.float32),
    mask: wp.array(dtype=wp.float32),
    sums: wp.array2d(dtype=wp.vec3),
    d_code: wp.array(dtype=vec16),
):
    ray = wp.tid()
    view = views[ray]
    direction = HALF * (rotations[view] * directions[ray])
    origin = in_voxels(origins[view])
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_inside(origin, direction, near, far, step, samples)
    passing = float(1.0)
    for i in range(inside[0], inside[1] + 1):
        o = occupancy_at(occupancy, origin + (near + float(i) * step) * direction)
        passing = passing * (1.0 - wp.min(o, _OPAQUE))
    depth[ray] = backdrop * passing
    mask[ray] = 1.0 - passing
    if gradients != 0 and passing > 1.0e-7:
        for i in range(inside[0], inside[1] + 1):
            delta = near + float(i) * step
            p = origin + delta * direction
            weight = -backdrop * passing / (1.0 - wp.min(occupancy_at(occupancy, p), _OPAQUE))
            add_sample(occupancy, jacobian, p, weight, delta, with_code, ray, sums, d_code)
