"""The decoder for one code with its 16 derivatives, visiting only what the ReLUs let through.

Exact, but for derivatives where the sigmoid's slope is under 1e-4: those are taken for zero.

A ReLU that is shut passes neither value nor derivative. About three quarters are shut at any code, before and
after each layer, so a dense pass does sixteen times the work that is needed. Here every voxel lists its open
channels, and the next layer visits no others. Values come first; derivatives (16 numbers, one vector
register) then only where they lead to a voxel that can still move, which are the ones near the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float
from torch import Tensor

from perception.shape.network import CHANNELS, DecoderNetwork
from perception.shape.sparse_kernels import (
    jacobian_kernel,
    occupancy_kernel,
    tangent_kernel,
    value_kernel,
    vec8,
    vec16,
    wanted_kernel,
)
from perception.types import CODE_SIZE, GRID_RESOLUTION
from perception.warp_runtime import empty, record, run_recorded, start_warp, to_device

_TAPS = 4  # of the convolutions, along each axis
_SHARED = 8  # cubes of this many voxels along each axis, and larger ones, are worth sharing between cores


class SparseDecoder:
    """One code at a time to its grid and the grid's derivatives; safe to call from several threads."""

    def __init__(self, network: DecoderNetwork, device: str) -> None:
        start_warp()
        self._device = device
        c1, _, _, c4, c5 = CHANNELS
        self._first_weight = _numpy(network.linear0.weight)
        self._first_bias = _numpy(network.linear0.bias)
        centre = np.zeros((c5, c4, _TAPS, _TAPS, _TAPS), np.float32)
        # the linear layer from 1^3 to 2^3 is a convolution, too: along each axis only taps 1 and 2 are used
        centre[..., 1:3, 1:3, 1:3] = _numpy(network.linear1.weight).T.reshape(c5, c4, 2, 2, 2)
        bias = _numpy(network.linear1.bias).reshape(c4, 8).T
        layers = [_Layer.of(1, centre, bias, device)]
        for side, layer in ((2, network.up2), (4, network.up3), (8, network.up4)):
            assert layer.bias is not None
            layers.append(_Layer.of(side, _numpy(layer.weight), _numpy(layer.bias)[None], device))
        # tap of each axis = phase + 2 near: [input, near x, phase x, near y, ...] to [near, input, phase]
        out = _numpy(network.out_weight).reshape(c1, 2, 2, 2, 2, 2, 2).transpose(1, 3, 5, 0, 2, 4, 6)
        self._layers = tuple(layers)
        self._out_weight = to_device(out.reshape(-1, 8), vec8, device)
        self._out_bias = float(network.out_bias)
        self._idle: dict[int, list[_Workspace]] = {}

    def __call__(
        self, code: Float[np.ndarray, "code"], category: int, with_jacobian: bool, threads: int = 1
    ) -> tuple[Float[Tensor, "x y z"], Float[Tensor, "x y z code"] | None]:
        """The grid of one code and, if asked for, d occupancy / d code; on the decoder's device.

        ``threads`` cores share the work on the CPU; the result is the same.
        """
        idle = self._idle.setdefault(threads if self._device == "cpu" else 1, [])
        try:
            workspace = idle.pop()
        except IndexError:
            workspace = _Workspace(self._layers, self._out_weight, self._out_bias, threads, self._device)
        grid = empty((GRID_RESOLUTION,) * 3, wp.float32, self._device)
        jacobian = empty((GRID_RESOLUTION,) * 3, vec16, self._device) if with_jacobian else None
        workspace.decode(*self._first(code, category), grid, jacobian)
        idle.append(workspace)
        wp.synchronize_device(self._device)  # torch goes on in a stream of its own
        return wp.to_torch(grid), None if jacobian is None else wp.to_torch(jacobian)

    def _first(self, code: np.ndarray, category: int) -> tuple[np.ndarray, np.ndarray]:
        """The linear layer from code and class, so small that numpy does it: values, derivatives."""
        total = self._first_weight[:, :CODE_SIZE] @ code + self._first_weight[:, CODE_SIZE + category]
        return total + self._first_bias, self._first_weight[:, :CODE_SIZE]


@dataclass(frozen=True)
class _Layer:
    """Weights of one transposed convolution, in the two orders that the kernels read them in."""

    side: int
    inputs: int
    outputs: int
    bias_rows: int
    weight: wp.array
    weight_by_output: wp.array
    bias: wp.array

    @staticmethod
    def of(
        side: int,
        weight: Float[np.ndarray, "inp out 4 4 4"],
        bias: Float[np.ndarray, "rows out"],
        device: str,
    ) -> _Layer:
        inputs, outputs = weight.shape[:2]
        taps = weight.reshape(inputs, outputs, _TAPS**3)
        return _Layer(
            side,
            inputs,
            outputs,
            len(bias),
            to_device(taps.transpose(2, 0, 1).reshape(-1, CODE_SIZE), vec16, device),
            to_device(taps.transpose(2, 1, 0).ravel(), wp.float32, device),
            to_device(bias.reshape(-1, CODE_SIZE), vec16, device),
        )


@dataclass(frozen=True)
class _Features:
    """The open channels of a cube of voxels: how many, which, values, derivatives, and whose are wanted."""

    count: wp.array
    channel: wp.array
    value: wp.array
    tangent: wp.array
    wanted: wp.array

    @staticmethod
    def room(side: int, channels: int, device: str) -> _Features:
        voxels = side**3
        return _Features(
            empty(voxels, wp.int32, device),
            empty(voxels * channels, wp.int32, device),
            empty(voxels * channels, wp.float32, device),
            empty(voxels * channels, vec16, device),
            to_device(np.ones(voxels), wp.uint8, device),
        )

    def set_single(self, total: Float[np.ndarray, "c"], tangent: Float[np.ndarray, "c code"]) -> None:
        """The open channels of a cube of one voxel."""
        channel = np.flatnonzero(total > 0)
        n = len(channel)
        for array, values in (
            (self.channel, channel), (self.value, total[channel]), (self.tangent, tangent[channel])
        ):  # fmt: skip
            array[:n].assign(values)
        self.count.fill_(n)


class _Workspace:
    """Room for one pass through the layers, and its launches."""

    def __init__(
        self, layers: Sequence[_Layer], out_weight: wp.array, out_bias: float, threads: int, device: str
    ) -> None:
        self._features = [_Features.room(1, layers[0].inputs, device)]
        self._values: list[_Shares] = []
        self._tangents: list[_Shares] = []
        for layer in layers:
            side, here = 2 * layer.side, self._features[-1]
            there = _Features.room(side, layer.outputs, device)
            sizes, listed = (layer.side, layer.inputs, layer.outputs), (here.count, here.channel)
            values = (*sizes, layer.weight, layer.bias, layer.bias_rows, *listed, here.value)
            out = (there.count, there.channel)
            self._values.append(_Shares(value_kernel, side, values, (*out, there.value), threads, device))
            tangents = (*sizes, layer.weight_by_output, *listed, here.tangent, *out, there.wanted)
            self._tangents.append(_Shares(tangent_kernel, side, tangents, (there.tangent,), threads, device))
            self._features.append(there)
        last, side, corners = self._features[-1], 2 * layers[-1].side, 2 * layers[-1].side + 1
        movable = empty(corners**3, wp.uint8, device)
        sizes, listed = (side, layers[-1].outputs, out_weight), (last.count, last.channel)
        cube, rows = empty((1, 1, 1), wp.float32, device), empty((1, 1, 1), vec16, device)
        self._occupancy = _Shares(
            occupancy_kernel,
            corners,
            (*sizes, out_bias, *listed, last.value),
            (movable, cube),
            threads,
            device,
        )
        self._jacobian = _Shares(
            jacobian_kernel, corners, (*sizes, *listed, last.tangent), (cube, rows), threads, device
        )
        # Corners i and i + 1 lie beside voxel i; fine voxels from 2 i - 1 to 2 i + 2 take from it.
        self._wanted = [_wanting(1, 0, 1, corners, side, movable, last.wanted, device)]
        for layer, fine, coarse in zip(layers[:1:-1], self._features[::-1], self._features[-2::-1]):
            side = layer.side
            self._wanted.append(_wanting(2, -1, 2, 2 * side, side, fine.wanted, coarse.wanted, device))

    def decode(
        self,
        total: Float[np.ndarray, "c"],
        tangent: Float[np.ndarray, "c code"],
        grid: wp.array,
        jacobian: wp.array | None,
    ) -> None:
        """Fills the grid and, if given, its Jacobian, from the first layer's sums and their derivatives."""
        self._features[0].set_single(total, tangent)
        for layer in self._values:
            layer()
        self._occupancy(grid)
        if jacobian is None:
            return
        for marking in self._wanted:
            marking.launch()
        for layer in self._tangents:
            layer()
        self._jacobian(grid, jacobian)


class _Shares:
    """A kernel's launches over a cube, cut along x for the cores; each run sets their last arguments."""

    def __init__(
        self, kernel: Any, side: int, inputs: Sequence[Any], outputs: Sequence[Any], threads: int, device: str
    ) -> None:
        shares = threads if device == "cpu" and side >= _SHARED else 1
        ends = np.linspace(0, side, shares + 1).astype(int).tolist()
        self._arguments = 1 + len(inputs) + len(outputs)
        self._launches = [
            record(kernel, (end - begin, side, side), [begin, *inputs], outputs, device)
            for begin, end in pairwise(ends)
        ]

    def __call__(self, *last: wp.array) -> None:
        run_recorded(self._launches, dict(enumerate(last, start=self._arguments - len(last))))


def _wanting(
    stride: int,
    low: int,
    high: int,
    fine_side: int,
    side: int,
    fine: wp.array,
    coarse: wp.array,
    device: str,
) -> Any:
    sizes = [stride, low, high, fine_side, side]
    return record(wanted_kernel, (side,) * 3, [*sizes, fine], [coarse], device)


def _numpy(parameter: Tensor) -> np.ndarray:
    return parameter.detach().cpu().float().numpy()
