# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Multi-object rendering for camera tracking: all pairs of a ray and an object in one launch, minimum depth.

NodeSLAM, section "Probabilistic Rendering" (multi-object rendering). Shapes are fixed; depth and weights w_i
are those of ``kernel.py``. The derivative is with respect to a local camera motion,
T_world_camera <- T_world_camera Exp(xi), xi = (rotation [rad], translation [m]) in the camera frame. A sample
at depth delta of the ray d moves by xi_r x (delta d) + xi_t, so with the sums
s1 = sum w_i grad o_i and s2 = sum w_i delta_i grad o_i, gradients in the camera frame,

    dD/dxi = (d x s2, s1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import no_type_check

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from perception.rendering.kernel import ESCAPE_FACTOR
from perception.rendering.renderer import ShapeGrid
from perception.rendering.sampling import (
    HALF,
    PADDED_VOXELS,
    cell_fraction,
    cell_index,
    samples_in_box,
    trilinear,
    trilinear_gradient,
    voxel_from_canonical,
)
from perception.warp_runtime import empty, in_parallel, record, to_device, zeros

_SIZE = wp.constant(PADDED_VOXELS)
_ESCAPE = wp.constant(ESCAPE_FACTOR)
_MIN_TRANSMITTANCE = wp.constant(
    1e-3
)  # larger than in ``kernel.py``: tracking needs less accuracy than shape fitting
_OCCUPIED = wp.constant(1)
MAX_SAMPLES = 192  # of a ray in occupied cells; samples beyond are ignored
_MAX_SAMPLES = wp.constant(MAX_SAMPLES)

wp.set_module_options(
    {
        "enable_backward": False,
        "optimization_level": 3,
        "cpu_compiler_flags": "-march=native -ffp-contract=fast",
    }
)


@dataclass(frozen=True)
class ShapeStack:
    """Padded grids of several objects, concatenated, on the CPU.

    Attributes:
        occupancy: (count * PADDED_VOXELS,) float32 occupancies.
        cells: (count * PADDED_VOXELS,) uint8 flags of the cells, see ``ShapeGrid``.
        boxes: (2 * count,) first and last flagged cell of each object.
        count: Number of objects.
    """

    occupancy: wp.array
    cells: wp.array
    boxes: wp.array
    count: int

    @staticmethod
    def of(shapes: Sequence[ShapeGrid]) -> ShapeStack:
        """Copy the grids into one stack."""
        occupancy = np.concatenate([shape.occupancy.numpy() for shape in shapes])
        cells = np.concatenate([shape.cells.numpy() for shape in shapes])
        boxes = np.concatenate([shape.box.numpy() for shape in shapes])
        return ShapeStack(
            wp.array(occupancy, dtype=wp.float32, device="cpu"),
            wp.array(cells, dtype=wp.uint8, device="cpu"),
            wp.array(boxes, dtype=wp.vec3i, device="cpu"),
            len(shapes),
        )


@dataclass(frozen=True)
class RayPairs:
    """Pairs of a ray of one camera and an object that it may hit.

    Attributes:
        directions: (n, 3) back-projected pixels in the camera frame, z = 1.
        ray: (p,) index of each pair's ray.
        object: (p,) index of each pair's object.
        depth_range: (k, 2) smallest and largest depth of each object in [m].
        step: (k,) depth between samples in [m].
    """

    directions: Float[np.ndarray, "n 3"]
    ray: Int[np.ndarray, "p"]
    object: Int[np.ndarray, "p"]
    depth_range: Float[np.ndarray, "k 2"]
    step: Float[np.ndarray, "k"]

    @property
    def escape_depth(self) -> Float[np.ndarray, "k"]:
        """Rendered depth of rays that miss each object, in [m]."""
        return ESCAPE_FACTOR * self.depth_range[:, 1]


@dataclass(frozen=True)
class PairRendering:
    """Rendering of each pair of a ray and an object.

    Attributes:
        depth: (p,) expected depth in [m].
        variance: (p,) variance of the depth in [m^2].
        mask: (p,) probability that the ray hits the object.
        jacobian: (p, 6) d depth / d xi in [m/rad] and [m/m]; zero if rendered without gradients.
    """

    depth: Float[np.ndarray, "p"]
    variance: Float[np.ndarray, "p"]
    mask: Float[np.ndarray, "p"]
    jacobian: Float[np.ndarray, "p 6"]


class PairRenderer:
    """Renders fixed pairs at varying poses.

    Constant inputs are uploaded once, since passing a small array costs as much as rendering a hundred
    pixels. Not thread-safe.
    """

    def __init__(self, stack: ShapeStack, pairs: RayPairs, gradients: bool = True, threads: int = 1) -> None:
        """Record the launches.

        Args:
            stack: Grids of all objects.
            pairs: Rays and objects to render.
            gradients: Compute the derivative with respect to the camera pose; without, it is zero.
            threads: Number of cores that share the pairs; the result does not depend on it.
        """
        self.pairs = pairs
        n = len(pairs.ray)
        self._out = empty((n, 3), wp.float32, "cpu")
        self._rows = zeros((n, 2), wp.vec3, "cpu")
        self._matrices = zeros(stack.count, wp.mat33, "cpu")
        self._origins = zeros(stack.count, wp.vec3, "cpu")
        inputs = [
            stack.occupancy,
            stack.cells,
            stack.boxes,
            to_device(pairs.directions, wp.vec3, "cpu"),
            to_device(pairs.ray, wp.int32, "cpu"),
            to_device(pairs.object, wp.int32, "cpu"),
            self._matrices,
            self._origins,
            to_device(pairs.depth_range, wp.vec2, "cpu"),
            to_device(pairs.step, wp.float32, "cpu"),
            int(gradients),
        ]
        parts = np.linspace(0, n, threads + 1).astype(int).tolist()
        self._parts = [
            record(
                pairs_kernel,
                dim=end - begin,
                inputs=[begin, *inputs, empty(MAX_SAMPLES, wp.vec3, "cpu")],
                outputs=[self._out, self._rows],
                device="cpu",
            )
            for begin, end in pairwise(parts)
            if end > begin
        ]

    def __call__(self, A_canonical_camera: Float[np.ndarray, "k 3 4"]) -> PairRendering:
        """Render every pair independently.

        Args:
            A_canonical_camera: Affine maps from the camera frame to each object's canonical cube.
        """
        if self._parts:
            self._matrices.numpy()[:] = A_canonical_camera[:, :, :3]
            self._origins.numpy()[:] = A_canonical_camera[:, :, 3]
            in_parallel([part.launch for part in self._parts])
        depth, variance, mask = self._out.numpy().T.copy()
        return PairRendering(depth, variance, mask, self._rows.numpy().reshape(-1, 6).copy())


def nearest_pair(
    pairs: RayPairs, own: Bool[np.ndarray, "p"], depth: Float[np.ndarray, "p"], mask: Float[np.ndarray, "p"]
) -> Int[np.ndarray, "n"]:
    """Return the index of the visible pair of every ray: the one of minimum depth.

    Candidates are the pair of the object to which the ray's pixel is assigned (``own``) and pairs with a hit
    probability above 0.5. Rays must be in ascending order in ``pairs.ray``, each with at least one candidate.
    """
    key = np.where(own | (mask > 0.5), depth, np.inf)
    starts = np.flatnonzero(np.diff(pairs.ray, prepend=-1))
    lengths = np.diff(np.append(starts, len(key)))
    is_least = key == np.repeat(np.minimum.reduceat(key, starts), lengths) if len(key) else key == key
    chosen = np.flatnonzero(is_least)
    return chosen[np.flatnonzero(np.diff(pairs.ray[chosen], prepend=-1))]


@wp.kernel
@no_type_check  # Warp types are unknown to the run-time type checker of the tests
def pairs_kernel(
    begin: int,
    occupancy: wp.array(dtype=wp.float32),
    cells: wp.array(dtype=wp.uint8),
    boxes: wp.array(dtype=wp.vec3i),
    directions: wp.array(dtype=wp.vec3),
    ray_of: wp.array(dtype=wp.int32),
    object_of: wp.array(dtype=wp.int32),
    matrices: wp.array(dtype=wp.mat33),
    origins: wp.array(dtype=wp.vec3),
    depth_range: wp.array(dtype=wp.vec2),
    steps: wp.array(dtype=wp.float32),
    gradients: int,
    stack: wp.array(dtype=wp.vec3),
    out: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3),
):
    """Render the pairs from ``begin`` on, one after the other on the CPU: they share one sample stack."""
    pair = begin + wp.tid()
    k = object_of[pair]
    base = k * _SIZE
    d = directions[ray_of[pair]]
    direction = HALF * (matrices[k] * d)
    origin = voxel_from_canonical(origins[k])
    near = depth_range[k][0]
    far = depth_range[k][1]
    step = steps[k]
    inside = samples_in_box(origin, direction, near, far, step, 1000000, boxes, 2 * k)

    count = int(0)
    transmittance = float(1.0)
    for i in range(inside[0], inside[1] + 1):
        delta = near + float(i) * step
        p = origin + delta * direction
        at = base + cell_index(p)
        if (int(cells[at]) & _OCCUPIED) != 0 and count < _MAX_SAMPLES:
            o = trilinear(occupancy, at, cell_fraction(p))
            stack[count] = wp.vec3(delta, o, transmittance)
            count += 1
            transmittance = transmittance * (1.0 - o)
            if transmittance < _MIN_TRANSMITTANCE:
                break

    mid_depth = 0.5 * (near + far)
    mean = _ESCAPE * far - mid_depth
    square = mean * mean
    sum_gradient = wp.vec3()
    sum_depth_gradient = wp.vec3()
    for n in range(count):
        entry = stack[count - 1 - n]
        delta = entry[0]
        o = entry[1]
        weight = entry[2] * (delta - mid_depth - mean)
        mean = wp.lerp(mean, delta - mid_depth, o)
        square = wp.lerp(square, (delta - mid_depth) * (delta - mid_depth), o)
        if gradients != 0:
            p = origin + delta * direction
            slope = (weight * HALF) * trilinear_gradient(occupancy, base + cell_index(p), cell_fraction(p))
            sum_gradient += slope
            sum_depth_gradient += delta * slope
    out[pair, 0] = mean + mid_depth
    out[pair, 1] = wp.max(square - mean * mean, 0.0)
    out[pair, 2] = 1.0 - transmittance
    if gradients != 0:
        transposed = wp.transpose(matrices[k])
        rows[pair, 0] = wp.cross(d, transposed * sum_depth_gradient)
        rows[pair, 1] = transposed * sum_gradient
