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
from typing import Any, no_type_check

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from perception.rendering.kernel import ESCAPE_FACTOR, PADDED_VOXELS
from perception.rendering.renderer import ShapeGrid
from perception.types import GRID_RESOLUTION

_SIDE = wp.constant(GRID_RESOLUTION + 2)
_SLAB = wp.constant((GRID_RESOLUTION + 2) ** 2)
_SIZE = wp.constant(PADDED_VOXELS)
_HALF = wp.constant(GRID_RESOLUTION / 2.0)
_END = wp.constant(GRID_RESOLUTION + 1.0)
_MARGIN = wp.constant(1e-3)
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
    count: int

    @staticmethod
    def of(shapes: Sequence[ShapeGrid]) -> ShapeStack:
        """Copies the grids; worth keeping until one of them changes."""
        occupancy = np.concatenate([shape.occupancy.numpy() for shape in shapes])
        cells = np.concatenate([shape.cells.numpy() for shape in shapes])
        return ShapeStack(
            wp.array(occupancy, dtype=wp.float32, device="cpu"),
            wp.array(cells, dtype=wp.uint8, device="cpu"),
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

    def __init__(self, stack: ShapeStack, pairs: RayPairs, gradients: bool = True) -> None:
        """``gradients``: whether the derivative by the camera's pose is wanted; without, it is left 0."""
        self.pairs = pairs
        n = len(pairs.ray)
        self._out = _empty((n, 3), wp.float32)
        self._rows = wp.zeros((n, 2), dtype=wp.vec3, device="cpu")
        self._matrices = wp.zeros(stack.count, dtype=wp.mat33, device="cpu")
        self._origins = wp.zeros(stack.count, dtype=wp.vec3, device="cpu")
        self._command: Any = wp.launch(
            pairs_kernel,
            dim=1,
            inputs=[
                n,
                stack.occupancy,
                stack.cells,
                _array(pairs.directions, wp.vec3),
                _array(pairs.ray, wp.int32),
                _array(pairs.object, wp.int32),
                self._matrices,
                self._origins,
                _array(pairs.depth_range, wp.vec2),
                _array(pairs.step, wp.float32),
                int(gradients),
                _empty(3 * MAX_SAMPLES, wp.float32),
            ],
            outputs=[self._out, self._rows],
            device="cpu",
            record_cmd=True,
        )

    def __call__(self, A_canonical_camera: Float[np.ndarray, "k 3 4"]) -> PairRendering:
        """Each pair by itself, with affine maps from the camera's frame into each object's canonical cube."""
        if len(self.pairs.ray):
            self._matrices.numpy()[:] = A_canonical_camera[:, :, :3]
            self._origins.numpy()[:] = A_canonical_camera[:, :, 3]
            self._command.launch()
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


def _empty(shape: int | tuple[int, ...], dtype: Any) -> wp.array:
    return wp.empty(shape, dtype=dtype, device="cpu")


def _array(values: np.ndarray, dtype) -> wp.array:
    scalar = np.int32 if dtype is wp.int32 else np.float32
    return wp.array(np.ascontiguousarray(values, scalar), dtype=dtype, device="cpu")


@wp.kernel
@no_type_check  # for the run-time checker of the tests: these are Warp types
def pairs_kernel(
    count_pairs: int,
    occupancy: wp.array(dtype=wp.float32),
    cells: wp.array(dtype=wp.uint8),
    directions: wp.array(dtype=wp.vec3),
    ray_of: wp.array(dtype=wp.int32),
    object_of: wp.array(dtype=wp.int32),
    matrices: wp.array(dtype=wp.mat33),
    origins: wp.array(dtype=wp.vec3),
    depth_range: wp.array(dtype=wp.vec2),
    steps: wp.array(dtype=wp.float32),
    gradients: int,
    scratch: wp.array(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
    rows: wp.array2d(dtype=wp.vec3),
):
    # One thread for all pairs: the scratch space of a ray stays in the cache.
    for pair in range(count_pairs):
        k = object_of[pair]
        base = k * _SIZE
        d = directions[ray_of[pair]]
        matrix = matrices[k]
        direction = _HALF * (matrix * d)
        origin = _HALF * origins[k] + wp.vec3(_HALF + 0.5, _HALF + 0.5, _HALF + 0.5)
        near = depth_range[k][0]
        far = depth_range[k][1]
        step = steps[k]
        enter = near
        leave = far
        for axis in range(3):
            slope = direction[axis]
            if wp.abs(slope) > 1.0e-9:
                a = (_MARGIN - origin[axis]) / slope
                b = (_END - _MARGIN - origin[axis]) / slope
                enter = wp.max(enter, wp.min(a, b))
                leave = wp.min(leave, wp.max(a, b))
            elif origin[axis] < _MARGIN or origin[axis] > _END - _MARGIN:
                leave = near - 1.0
        first = wp.max(int(wp.ceil((enter - near) / step)), 1)
        last = int(wp.floor((leave - near) / step))

        count = int(0)
        reaching = float(1.0)
        for i in range(first, last + 1):
            delta = near + float(i) * step
            p = origin + delta * direction
            ix = int(p[0])
            iy = int(p[1])
            iz = int(p[2])
            at = base + (ix * _SIDE + iy) * _SIDE + iz
            if (int(cells[at]) & _OCCUPIED) != 0 and count < _MAX_SAMPLES:
                x = p[0] - float(ix)
                y = p[1] - float(iy)
                z = p[2] - float(iz)
                o00 = wp.lerp(occupancy[at], occupancy[at + 1], z)
                o01 = wp.lerp(occupancy[at + _SIDE], occupancy[at + _SIDE + 1], z)
                o10 = wp.lerp(occupancy[at + _SLAB], occupancy[at + _SLAB + 1], z)
                o11 = wp.lerp(occupancy[at + _SLAB + _SIDE], occupancy[at + _SLAB + _SIDE + 1], z)
                o = wp.lerp(wp.lerp(o00, o01, y), wp.lerp(o10, o11, y), x)
                scratch[3 * count] = delta
                scratch[3 * count + 1] = o
                scratch[3 * count + 2] = reaching
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
            m = 3 * (count - 1 - n)
            delta = scratch[m]
            o = scratch[m + 1]
            weight = scratch[m + 2] * (delta - middle - mean)
            mean = wp.lerp(mean, delta - middle, o)
            square = wp.lerp(square, (delta - middle) * (delta - middle), o)
            if gradients != 0:
                p = origin + delta * direction
                ix = int(p[0])
                iy = int(p[1])
                iz = int(p[2])
                at = base + (ix * _SIDE + iy) * _SIDE + iz
                x = p[0] - float(ix)
                y = p[1] - float(iy)
                z = p[2] - float(iz)
                o000 = occupancy[at]
                o001 = occupancy[at + 1]
                o010 = occupancy[at + _SIDE]
                o011 = occupancy[at + _SIDE + 1]
                o100 = occupancy[at + _SLAB]
                o101 = occupancy[at + _SLAB + 1]
                o110 = occupancy[at + _SLAB + _SIDE]
                o111 = occupancy[at + _SLAB + _SIDE + 1]
                o00 = wp.lerp(o000, o001, z)
                o01 = wp.lerp(o010, o011, z)
                o10 = wp.lerp(o100, o101, z)
                o11 = wp.lerp(o110, o111, z)
                slopes = (weight * _HALF) * wp.vec3(
                    wp.lerp(o10, o11, y) - wp.lerp(o00, o01, y),
                    wp.lerp(o01, o11, x) - wp.lerp(o00, o10, x),
                    wp.lerp(wp.lerp(o001 - o000, o011 - o010, y), wp.lerp(o101 - o100, o111 - o110, y), x),
                )
                sum_gradient += slopes
                sum_depth_gradient += delta * slopes
        out[pair, 0] = mean + middle
        out[pair, 1] = wp.max(square - mean * mean, 0.0)
        out[pair, 2] = 1.0 - reaching
        if gradients != 0:
            turned = wp.transpose(matrix)
            rows[pair, 0] = wp.cross(d, turned * sum_depth_gradient)
            rows[pair, 1] = turned * sum_gradient
