# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""Many objects in one image: every pair of a ray and an object in one launch, composed by the least depth.

The same integral and the same derivative as in ``kernel.py``, for fixed shapes: what camera tracking needs.
The camera moves locally, T_world_camera <- T_world_camera Exp(xi), xi = (rotation [rad], translation [m]) in
its own frame. A sample at depth delta of the ray d moves by xi_r x (delta d) + xi_t, so with the sums
s1 = sum w_i grad o_i and s2 = sum w_i delta_i grad o_i, gradients taken in the camera's frame,

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
    cell_of,
    in_cell,
    in_voxels,
    samples_in_box,
    slopes,
    trilinear,
)
from perception.warp_runtime import empty, in_parallel, record, to_device, zeros

_SIZE = wp.constant(PADDED_VOXELS)
_ESCAPE = wp.constant(ESCAPE_FACTOR)
_OPAQUE = wp.constant(1e-3)  # coarser than when shapes are fitted: no step is that long
_OCCUPIED = wp.constant(1)
MAX_SAMPLES = 192
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
    """The grids of several objects, one behind the other."""

    occupancy: wp.array
    cells: wp.array
    boxes: wp.array
    count: int

    @staticmethod
    def of(shapes: Sequence[ShapeGrid]) -> ShapeStack:
        """Copies the grids; worth keeping until one of them changes."""
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
    """Rays of one camera and the objects that each may meet.

    Attributes:
        directions: (n, 3) back-projected pixels, z = 1.
        ray, object: (p,) indices of the pairs.
        depth_range: (k, 2) nearest and farthest depth of each object [m].
        step: (k,) between samples, in depth [m].
    """

    directions: Float[np.ndarray, "n 3"]
    ray: Int[np.ndarray, "p"]
    object: Int[np.ndarray, "p"]
    depth_range: Float[np.ndarray, "k 2"]
    step: Float[np.ndarray, "k"]

    @property
    def escape_depth(self) -> Float[np.ndarray, "k"]:
        """Depth of rays that miss each object [m]."""
        return ESCAPE_FACTOR * self.depth_range[:, 1]


@dataclass(frozen=True)
class PairRendering:
    """What each pair renders: depth [m], its variance [m^2], probability of a hit, and d depth / d xi."""

    depth: Float[np.ndarray, "p"]
    variance: Float[np.ndarray, "p"]
    mask: Float[np.ndarray, "p"]
    jacobian: Float[np.ndarray, "p 6"]


class PairRenderer:
    """Renders the same pairs from one pose after another.

    Everything that stays the same is brought to the renderer once: the arrays are small, and handing one over
    costs as much as rendering a hundred pixels. Used by one thread at a time.
    """

    def __init__(self, stack: ShapeStack, pairs: RayPairs, gradients: bool = True, threads: int = 1) -> None:
        """``gradients``: whether the derivative by the camera's pose is wanted; without, it is left 0.

        ``threads`` share the pairs; the result is the same.
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
        """Each pair by itself, with affine maps from the camera's frame into each object's canonical cube."""
        if self._parts:
            self._matrices.numpy()[:] = A_canonical_camera[:, :, :3]
            self._origins.numpy()[:] = A_canonical_camera[:, :, 3]
            in_parallel([part.launch for part in self._parts])
        depth, variance, mask = self._out.numpy().T.copy()
        return PairRendering(depth, variance, mask, self._rows.numpy().reshape(-1, 6).copy())


def nearest_pair(
    pairs: RayPairs, own: Bool[np.ndarray, "p"], depth: Float[np.ndarray, "p"], mask: Float[np.ndarray, "p"]
) -> Int[np.ndarray, "n"]:
    """For every ray the pair that it shows: the least depth of its own object and of those it surely hits.

    Rays must be in ascending order in ``pairs.ray``, each with at least one pair.
    """
    key = np.where(own | (mask > 0.5), depth, np.inf)
    starts = np.flatnonzero(np.diff(pairs.ray, prepend=-1))
    lengths = np.diff(np.append(starts, len(key)))
    is_least = key == np.repeat(np.minimum.reduceat(key, starts), lengths) if len(key) else key == key
    chosen = np.flatnonzero(is_least)
    return chosen[np.flatnonzero(np.diff(pairs.ray[chosen], prepend=-1))]


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
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
    """The pairs from ``begin`` on, one after the other: all use the same room for a ray's samples."""
    pair = begin + wp.tid()
    k = object_of[pair]
    base = k * _SIZE
    d = directions[ray_of[pair]]
    direction = HALF * (matrices[k] * d)
    origin = in_voxels(origins[k])
    near = depth_range[k][0]
    far = depth_range[k][1]
    step = steps[k]
    inside = samples_in_box(origin, direction, near, far, step, 1000000, boxes, 2 * k)

    count = int(0)
    reaching = float(1.0)
    for i in range(inside[0], inside[1] + 1):
        delta = near + float(i) * step
        p = origin + delta * direction
        at = base + cell_of(p)
        if (int(cells[at]) & _OCCUPIED) != 0 and count < _MAX_SAMPLES:
            o = trilinear(occupancy, at, in_cell(p))
            stack[count] = wp.vec3(delta, o, reaching)
            count += 1
            reaching = reaching * (1.0 - o)
            if reaching < _OPAQUE:
                break

    middle = 0.5 * (near + far)
    mean = _ESCAPE * far - middle
    square = mean * mean
    sum_gradient = wp.vec3()
    sum_depth_gradient = wp.vec3()
    for n in range(count):
        entry = stack[count - 1 - n]
        delta = entry[0]
        o = entry[1]
        weight = entry[2] * (delta - middle - mean)
        mean = wp.lerp(mean, delta - middle, o)
        square = wp.lerp(square, (delta - middle) * (delta - middle), o)
        if gradients != 0:
            p = origin + delta * direction
            slope = (weight * HALF) * slopes(occupancy, base + cell_of(p), in_cell(p))
            sum_gradient += slope
            sum_depth_gradient += delta * slope
    out[pair, 0] = mean + middle
    out[pair, 1] = wp.max(square - mean * mean, 0.0)
    out[pair, 2] = 1.0 - reaching
    if gradients != 0:
        turned = wp.transpose(matrices[k])
        rows[pair, 0] = wp.cross(d, turned * sum_depth_gradient)
        rows[pair, 1] = turned * sum_gradient
