# ruff: noqa: UP018, RUF046  -- int(0) and float(1) declare variables in Warp, literals are constants
"""The decoder for one code with its 16 derivatives, exact, visiting only what the ReLUs let through.

A ReLU that is shut passes neither value nor derivative. About three quarters are shut at any code, before and
after each layer, so a dense pass does sixteen times the work that is needed. Here every voxel lists its open
channels with their values and derivatives (16 numbers, one vector register); the next layer visits no others.

All layers are transposed convolutions of kernel 4, stride 2, padding 1: along each axis fine voxel f takes
the coarse voxels i = (f + 1) // 2 and i - 1 through the taps f + 1 - 2 i. The linear layer from 1^3 to 2^3 is
one, too, most of whose taps are never used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import numpy as np
import warp as wp
from jaxtyping import Float
from torch import Tensor

from perception.shape.network import CHANNELS, Decoder
from perception.types import CODE_SIZE, GRID_RESOLUTION
from perception.warp_runtime import empty, launch, start_warp, to_device

_KERNEL = 4
_BLOCK = wp.constant(16)  # output channels whose values are computed together
_FLAT = wp.constant(1e-5)  # slope of the sigmoid below which a voxel is taken not to move

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
@no_type_check
def layer_kernel(
    side: int,
    inputs: int,
    outputs: int,
    with_tangents: int,
    weight: wp.array(dtype=vec16),
    weight_by_output: wp.array(dtype=wp.float32),
    bias: wp.array(dtype=vec16),
    bias_rows: int,
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_value: wp.array(dtype=wp.float32),
    in_tangent: wp.array(dtype=vec16),
    count: wp.array(dtype=wp.int32),
    channel: wp.array(dtype=wp.int32),
    value: wp.array(dtype=wp.float32),
    tangent: wp.array(dtype=vec16),
):
    """One transposed convolution and ReLU; a thread computes all channels of one fine voxel.

    ``side`` is the coarse grid's. Arrays are flat: ``weight[tap, input, block]`` holds 16 outputs,
    ``weight_by_output`` is ordered [tap, output, input]; ``bias`` has a row for all voxels, or one for each.
    """
    x, y, z = wp.tid()
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
    if with_tangents != 0:
        m = int(first)
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
def last_kernel(
    side: int,
    inputs: int,
    with_tangents: int,
    weight: wp.array(dtype=vec8),
    bias: float,
    in_count: wp.array(dtype=wp.int32),
    in_channel: wp.array(dtype=wp.int32),
    in_value: wp.array(dtype=wp.float32),
    in_tangent: wp.array(dtype=vec16),
    occupancy: wp.array3d(dtype=wp.float32),
    jacobian: wp.array3d(dtype=vec16),
):
    """The transposed convolution to a single channel, and the sigmoid.

    A thread computes the eight fine voxels around one corner between coarse voxels: they take from the same
    eight of them. ``weight[near, input]`` holds what goes to the eight.
    """
    x, y, z = wp.tid()
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
    for phase in range(8):
        fx = 2 * x - 1 + (phase >> 2)
        fy = 2 * y - 1 + ((phase >> 1) & 1)
        fz = 2 * z - 1 + (phase & 1)
        if wp.min(wp.min(fx, fy), fz) >= 0 and wp.max(wp.max(fx, fy), fz) < 2 * side:
            o = 1.0 / (1.0 + wp.exp(-total[phase] - bias))
            occupancy[fx, fy, fz] = o
            total[phase] = o * (1.0 - o)
        else:
            total[phase] = -1.0
    if with_tangents != 0:
        phase = int(0)
        while phase < 8:
            slope = total[phase]
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
            if slope >= 0.0:
                fx = 2 * x - 1 + (phase >> 2)
                fy = 2 * y - 1 + ((phase >> 1) & 1)
                fz = 2 * z - 1 + (phase & 1)
                jacobian[fx, fy, fz] = row
            phase += 1


@dataclass(frozen=True)
class _Layer:
    """Weights of one transposed convolution, in the two orders that the kernel reads them in."""

    side: int
    inputs: int
    outputs: int
    bias_rows: int
    weight: wp.array
    weight_by_output: wp.array
    bias: wp.array


class SparseDecoder:
    """One code at a time to its grid and the grid's derivatives; safe to call from several threads."""

    def __init__(self, network: Decoder, device: str) -> None:
        start_warp()
        self._device = device
        c1, _, _, c4, c5 = CHANNELS
        self._first_weight = _numpy(network.linear0.weight)
        self._first_bias = _numpy(network.linear0.bias)
        centre = np.zeros((c5, c4, _KERNEL, _KERNEL, _KERNEL), np.float32)
        # from one voxel to two along each axis only taps 1 and 2 are used
        centre[..., 1:3, 1:3, 1:3] = _numpy(network.linear1.weight).T.reshape(c5, c4, 2, 2, 2)
        bias = _numpy(network.linear1.bias).reshape(c4, 8).T
        self._layers = [self._layer(1, centre, bias)]
        for side, layer in ((2, network.up2), (4, network.up3), (8, network.up4)):
            assert layer.bias is not None
            self._layers.append(self._layer(side, _numpy(layer.weight), _numpy(layer.bias)[None]))
        # tap of each axis = phase + 2 near: [input, near x, phase x, near y, ...] to [near, input, phase]
        out = _numpy(network.out_weight).reshape(c1, 2, 2, 2, 2, 2, 2).transpose(1, 3, 5, 0, 2, 4, 6)
        self._out_weight = self._array(out.reshape(-1, 8), vec8)
        self._out_bias = float(network.out_bias)

    def __call__(
        self, code: Float[np.ndarray, "code"], category: int, with_jacobian: bool
    ) -> tuple[Float[Tensor, "x y z"], Float[Tensor, "x y z code"] | None]:
        """The grid of one code and, if asked for, d occupancy / d code; on the decoder's device."""
        found = self._first(code, category)
        for layer in self._layers:
            side = 2 * layer.side
            there = self._room(side**3, layer.outputs)
            sizes = [layer.side, layer.inputs, layer.outputs, int(with_jacobian)]
            weights = [layer.weight, layer.weight_by_output, layer.bias, layer.bias_rows]
            launch(
                layer_kernel,
                (side,) * 3,
                [*sizes, *weights, *found],
                there,
                self._device,
            )
            found = there
        grid = empty((GRID_RESOLUTION,) * 3, wp.float32, self._device)
        rows = (GRID_RESOLUTION,) * 3 if with_jacobian else (1, 1, 1)
        jacobian = empty(rows, vec16, self._device)
        launch(
            last_kernel,
            (GRID_RESOLUTION // 2 + 1,) * 3,
            [
                GRID_RESOLUTION // 2,
                CHANNELS[0],
                int(with_jacobian),
                self._out_weight,
                self._out_bias,
                *found,
            ],
            [grid, jacobian],
            self._device,
        )
        wp.synchronize_device(self._device)  # torch goes on in a stream of its own
        return wp.to_torch(grid), wp.to_torch(jacobian) if with_jacobian else None

    def _first(self, code: np.ndarray, category: int) -> list[wp.array]:
        """The linear layer from code and class: so small that numpy does it."""
        total = self._first_weight[:, :CODE_SIZE] @ code + self._first_weight[:, CODE_SIZE + category]
        total += self._first_bias
        channel = np.flatnonzero(total > 0)
        count = np.array([len(channel)])
        return [
            self._array(count, wp.int32),
            self._array(channel, wp.int32),
            self._array(total[channel], wp.float32),
            self._array(self._first_weight[channel, :CODE_SIZE], vec16),
        ]

    def _room(self, voxels: int, channels: int) -> list[wp.array]:
        """For each voxel the number of its open channels; which they are, their values and derivatives."""
        n = voxels * channels
        kinds = ((voxels, wp.int32), (n, wp.int32), (n, wp.float32), (n, vec16))
        return [empty(length, dtype, self._device) for length, dtype in kinds]

    def _layer(
        self, side: int, weight: Float[np.ndarray, "inp out 4 4 4"], bias: Float[np.ndarray, "rows out"]
    ) -> _Layer:
        inputs, outputs = weight.shape[:2]
        taps = weight.reshape(inputs, outputs, _KERNEL**3)
        return _Layer(
            side,
            inputs,
            outputs,
            len(bias),
            self._array(taps.transpose(2, 0, 1).reshape(-1, CODE_SIZE), vec16),
            self._array(taps.transpose(2, 1, 0).ravel(), wp.float32),
            self._array(bias.reshape(-1, CODE_SIZE), vec16),
        )

    def _array(self, values: np.ndarray, dtype: Any) -> wp.array:
        return to_device(values, dtype, self._device)


def _numpy(parameter: Tensor) -> np.ndarray:
    return parameter.detach().cpu().float().numpy()
