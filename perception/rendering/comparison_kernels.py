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

from perception.rendering.kernel import ESCAPE_FACTOR, vec16
from perception.types import GRID_RESOLUTION

_SIDE = wp.constant(GRID_RESOLUTION + 2)
_SLAB = wp.constant((GRID_RESOLUTION + 2) ** 2)
_HALF = wp.constant(GRID_RESOLUTION / 2.0)
_END = wp.constant(GRID_RESOLUTION + 1.0)
_MARGIN = wp.constant(1e-3)  # [voxel] keeps rounding from indexing outside
_ESCAPE = wp.constant(ESCAPE_FACTOR)
_SECANT_STEPS = wp.constant(8)
_LEAST_SLOPE = wp.constant(0.02)  # [1/voxel] of occupancy along the ray: grazing hits get no endless weight
_OPAQUE = wp.constant(0.9999)  # occupancies are cut off here, so that one can be divided out of a product

wp.set_module_options({"enable_backward": False, "optimization_level": 3})


@wp.func
@no_type_check
def occupancy_at(occupancy: wp.array(dtype=wp.float32), p: wp.vec3) -> float:
    """Trilinear, at a point in voxels of the padded grid."""
    ix = int(p[0])
    iy = int(p[1])
    iz = int(p[2])
    at = (ix * _SIDE + iy) * _SIDE + iz
    x = p[0] - float(ix)
    y = p[1] - float(iy)
    z = p[2] - float(iz)
    o00 = wp.lerp(occupancy[at], occupancy[at + 1], z)
    o01 = wp.lerp(occupancy[at + _SIDE], occupancy[at + _SIDE + 1], z)
    o10 = wp.lerp(occupancy[at + _SLAB], occupancy[at + _SLAB + 1], z)
    o11 = wp.lerp(occupancy[at + _SLAB + _SIDE], occupancy[at + _SLAB + _SIDE + 1], z)
    return wp.lerp(wp.lerp(o00, o01, y), wp.lerp(o10, o11, y), x)


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
    ix = int(p[0])
    iy = int(p[1])
    iz = int(p[2])
    at = (ix * _SIDE + iy) * _SIDE + iz
    x = p[0] - float(ix)
    y = p[1] - float(iy)
    z = p[2] - float(iz)
    gradient = wp.vec3()
    code = vec16()
    for a in range(2):
        for b in range(2):
            for c in range(2):
                wx = x if a == 1 else 1.0 - x
                wy = y if b == 1 else 1.0 - y
                wz = z if c == 1 else 1.0 - z
                corner = at + a * _SLAB + b * _SIDE + c
                o = occupancy[corner]
                gradient += o * wp.vec3(
                    float(2 * a - 1) * wy * wz, float(2 * b - 1) * wx * wz, float(2 * c - 1) * wx * wy
                )
                if with_code != 0:
                    code += (weight * wx * wy * wz) * jacobian[corner]
    slope = (weight * _HALF) * gradient
    sums[ray, 0] = sums[ray, 0] + slope
    sums[ray, 1] = sums[ray, 1] + delta * slope
    if with_code != 0:
        d_code[ray] = d_code[ray] + code


@wp.func
@no_type_check
def samples_inside(origin: wp.vec3, direction: wp.vec3, near: float, far: float, samples: int) -> wp.vec2i:
    """First and last sample of a ray inside the padded grid; the last is before the first where none is."""
    step = (far - near) / float(samples)
    enter = near
    leave = far
    for axis in range(3):
        d = direction[axis]
        if wp.abs(d) > 1.0e-9:
            a = (_MARGIN - origin[axis]) / d
            b = (_END - _MARGIN - origin[axis]) / d
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
        elif origin[axis] < _MARGIN or origin[axis] > _END - _MARGIN:
            leave = near - 1.0
    first = wp.max(int(wp.ceil((enter - near) / step)), 1)
    last = wp.min(int(wp.floor((leave - near) / step)), samples)
    return wp.vec2i(first, last)


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
    direction = _HALF * (rotations[view] * directions[ray])
    origin = _HALF * origins[view] + wp.vec3(_HALF + 0.5, _HALF + 0.5, _HALF + 0.5)
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_inside(origin, direction, near, far, samples)
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
    direction = _HALF * (rotations[view] * directions[ray])
    origin = _HALF * origins[view] + wp.vec3(_HALF + 0.5, _HALF + 0.5, _HALF + 0.5)
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_inside(origin, direction, near, far, samples)
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
