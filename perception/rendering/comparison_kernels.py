# ruff: noqa: UP018  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Warp kernels of the two baseline renderers, for CPU and CUDA.

Both sample the rays as ``kernel.render_kernel`` does and accumulate the same three sums, with other weights
w_i = d image / d o_i:

first crossing   D is the depth at which the occupancy first reaches a level. Implicit differentiation of
                 o(D(theta), theta) = level gives dD/dtheta = -(do/dtheta) / (do/dD): one sample of weight
                 -1 / (do/dD).
silhouette       S = L prod_i (1 - o_i), the expected depth of a silhouette at depth 0 in front of a
                 background at depth L: w_i = -L prod_{j != i} (1 - o_j).
"""

from typing import no_type_check

import warp as wp

from perception.rendering.kernel import ESCAPE_FACTOR
from perception.rendering.sampling import (
    HALF,
    cell_fraction,
    cell_index,
    samples_in_grid,
    trilinear,
    trilinear_gradient,
    trilinear_jacobian,
    vec16,
    voxel_from_canonical,
)

_ESCAPE = wp.constant(ESCAPE_FACTOR)
_SECANT_STEPS = wp.constant(8)
_MIN_SLOPE = wp.constant(
    0.02
)  # [1/voxel] do/dD is bounded below by it, which bounds the weight of grazing rays
_MAX_OCCUPANCY = wp.constant(0.9999)  # clipping that keeps 1 - o_i > 0, by which the product is divided

wp.set_module_options({"enable_backward": False, "optimization_level": 3})


@wp.func
@no_type_check
def occupancy_at(occupancy: wp.array(dtype=wp.float32), p: wp.vec3) -> float:
    """Interpolate the occupancy at a point in voxel units."""
    return trilinear(occupancy, cell_index(p), cell_fraction(p))


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
    """Add a sample's w grad o, w delta grad o (canonical units) and w do/dcode to the sums of its ray."""
    at = cell_index(p)
    slope = (weight * HALF) * trilinear_gradient(occupancy, at, cell_fraction(p))
    sums[ray, 0] = sums[ray, 0] + slope
    sums[ray, 1] = sums[ray, 1] + delta * slope
    if with_code != 0:
        d_code[ray] = d_code[ray] + weight * trilinear_jacobian(jacobian, at, cell_fraction(p))


@wp.kernel
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
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
    """Render the depth of the first upward crossing of ``level``; see the module's docstring."""
    ray = wp.tid()
    view = views[ray]
    direction = HALF * (rotations[view] * directions[ray])
    origin = voxel_from_canonical(origins[view])
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_in_grid(origin, direction, near, far, step, samples)
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
            width = 0.05 / wp.length(direction)  # central difference over 0.05 voxel to each side
            rise = occupancy_at(occupancy, p + width * direction) - occupancy_at(
                occupancy, p - width * direction
            )
            slope = rise / (2.0 * width)
            weight = -1.0 / wp.max(slope, _MIN_SLOPE * wp.length(direction))
            add_sample(occupancy, jacobian, p, weight, delta, with_code, ray, sums, d_code)


@wp.kernel
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
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
    """Render the silhouette in front of a background at depth ``backdrop``; see the module's docstring."""
    ray = wp.tid()
    view = views[ray]
    direction = HALF * (rotations[view] * directions[ray])
    origin = voxel_from_canonical(origins[view])
    near = depth_range[view][0]
    far = depth_range[view][1]
    step = (far - near) / float(samples)
    inside = samples_in_grid(origin, direction, near, far, step, samples)
    transmittance = float(1.0)
    for i in range(inside[0], inside[1] + 1):
        o = occupancy_at(occupancy, origin + (near + float(i) * step) * direction)
        transmittance = transmittance * (1.0 - wp.min(o, _MAX_OCCUPANCY))
    depth[ray] = backdrop * transmittance
    mask[ray] = 1.0 - transmittance
    if gradients != 0 and transmittance > 1.0e-7:
        for i in range(inside[0], inside[1] + 1):
            delta = near + float(i) * step
            p = origin + delta * direction
            weight = -backdrop * transmittance / (1.0 - wp.min(occupancy_at(occupancy, p), _MAX_OCCUPANCY))
            add_sample(occupancy, jacobian, p, weight, delta, with_code, ray, sums, d_code)
