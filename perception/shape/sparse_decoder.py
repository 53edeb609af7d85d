"""Sparse forward-mode evaluation of the decoder: one code to its grid and the Jacobian d occupancy / d code.

Exact, except for derivatives at voxels with a sigmoid slope o (1 - o) of at most 1e-4, which are zero.

A ReLU of negative input passes neither value nor derivative. About three quarters are inactive at any code,
before and after each layer, so a dense pass does sixteen times the necessary work. Here every voxel stores
its active channels, and the next layer reads no others. Values are computed first; derivatives (16 numbers,
one vector register) follow only at voxels from which a voxel near the surface is computed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import warp as wp
from jaxtyping import Float

from perception.shape.architecture import CHANNELS
from perception.shape.sparse_kernels import (
    jacobian_kernel,
    occupancy_kernel,
    propagate_mask_kernel,
    tangent_kernel,
    value_kernel,
    vec8,
    vec16,
)
from perception.types import CODE_SIZE, GRID_RESOLUTION
from perception.warp_runtime import empty, record, run_recorded, start_warp, to_device

_TAPS = 4  # of the transposed convolutions, along each axis
_MIN_SHARED_SIDE = 8  # [voxel]; smaller grids are computed by one thread


class SparseDecoder:
    """Decoder of single codes with analytic derivatives; thread-safe.

    Args:
        weights: Parameters of ``network.DecoderNetwork`` by name.
        device: "cpu" or "cuda:0".
    """

    def __init__(self, weights: Mapping[str, np.ndarray], device: str) -> None:
        start_warp()
        self._device = device
        c1, _, _, c4, c5 = CHANNELS
        self._first_weight = weights["linear0.weight"]
        self._first_bias = weights["linear0.bias"]
        centre = np.zeros((c5, c4, _TAPS, _TAPS, _TAPS), np.float32)
        # The linear layer from 1^3 to 2^3 is a transposed convolution of which only taps 1 and 2 are used.
        centre[..., 1:3, 1:3, 1:3] = weights["linear1.weight"].T.reshape(c5, c4, 2, 2, 2)
        bias = weights["linear1.bias"].reshape(c4, 8).T
        layers = [_Layer.of(1, centre, bias, device)]
        for side, name in ((2, "up2"), (4, "up3"), (8, "up4")):
            layers.append(_Layer.of(side, weights[f"{name}.weight"], weights[f"{name}.bias"][None], device))
        # tap = phase + 2 * neighbour: [input, neighbour x, phase x, ...] to [neighbour, input, phase]
        out = weights["out_weight"].reshape(c1, 2, 2, 2, 2, 2, 2).transpose(1, 3, 5, 0, 2, 4, 6)
        self._layers = tuple(layers)
        self._out_weight = to_device(out.reshape(-1, 8), vec8, device)
        self._out_bias = float(weights["out_bias"][0])
        self._idle: dict[int, list[_Workspace]] = {}

    def __call__(
        self, code: Float[np.ndarray, "code"], category: int, with_jacobian: bool, threads: int = 1
    ) -> tuple[Float[np.ndarray, "x y z"], Float[np.ndarray, "x y z code"] | None]:
        """Decode one code on the decoder's device and return the results in the host's memory.

        Args:
            code: Shape code.
            category: Index into CATEGORIES.
            with_jacobian: Whether to compute d occupancy / d code, which is None otherwise.
            threads: Number of cores that share the work on the CPU; the result does not depend on it.
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
        return grid.numpy(), None if jacobian is None else jacobian.numpy()

    def _first(self, code: np.ndarray, category: int) -> tuple[np.ndarray, np.ndarray]:
        """Return pre-activations of the first linear layer and their derivatives with respect to the code."""
        total = self._first_weight[:, :CODE_SIZE] @ code + self._first_weight[:, CODE_SIZE + category]
        return total + self._first_bias, self._first_weight[:, :CODE_SIZE]


@dataclass(frozen=True)
class _Layer:
    """Weights of one transposed convolution, in the memory orders of the value and tangent kernels.

    Attributes:
        side: Voxels along each axis of the input.
        inputs: Number of input channels.
        outputs: Number of output channels.
        bias_rows: 1, or the number of output voxels if each has its own bias.
        weight: [tap, input, block] vectors of 16 outputs.
        weight_by_output: [tap, output, input] floats.
        bias: [row, block] vectors of 16 outputs.
    """

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
class _Mask:
    """Voxels of a cubic grid whose derivatives are computed: ``marks`` is (side^3,) and nonzero there."""

    side: int
    marks: wp.array


@dataclass(frozen=True)
class _Features:
    """Active channels of a cubic grid.

    Attributes:
        side: Voxels along each axis.
        count: (side^3,) number of active channels of each voxel.
        channel: (side^3 * channels,) indices of the active channels, those of each voxel first in its row.
        value: (side^3 * channels,) their values.
        tangent: (side^3 * channels,) their derivatives with respect to the code.
        required: (side^3,) nonzero at voxels whose derivatives are computed.
    """

    side: int
    count: wp.array
    channel: wp.array
    value: wp.array
    tangent: wp.array
    required: wp.array

    @staticmethod
    def allocate(side: int, channels: int, device: str) -> _Features:
        voxels = side**3
        return _Features(
            side,
            empty(voxels, wp.int32, device),
            empty(voxels * channels, wp.int32, device),
            empty(voxels * channels, wp.float32, device),
            empty(voxels * channels, vec16, device),
            to_device(np.ones(voxels), wp.uint8, device),
        )

    @property
    def mask(self) -> _Mask:
        return _Mask(self.side, self.required)

    def set_single(self, total: Float[np.ndarray, "c"], tangent: Float[np.ndarray, "c code"]) -> None:
        """Set the active channels of a grid of one voxel, from pre-activations and their derivatives."""
        channel = np.flatnonzero(total > 0)
        n = len(channel)
        for array, values in (
            (self.channel, channel), (self.value, total[channel]), (self.tangent, tangent[channel])
        ):  # fmt: skip
            array[:n].assign(values)
        self.count.fill_(n)


class _Workspace:
    """Memory and recorded launches of one pass through the layers."""

    def __init__(
        self, layers: Sequence[_Layer], out_weight: wp.array, out_bias: float, threads: int, device: str
    ) -> None:
        self._features = [_Features.allocate(1, layers[0].inputs, device)]
        self._values: list[_SlabLaunches] = []
        self._tangents: list[_SlabLaunches] = []
        for layer in layers:
            side, coarse = 2 * layer.side, self._features[-1]
            fine = _Features.allocate(side, layer.outputs, device)
            sizes, listed = (layer.side, layer.inputs, layer.outputs), (coarse.count, coarse.channel)
            values = (*sizes, layer.weight, layer.bias, layer.bias_rows, *listed, coarse.value)
            out = (fine.count, fine.channel)
            self._values.append(
                _SlabLaunches(value_kernel, side, values, (*out, fine.value), threads, device)
            )
            tangents = (*sizes, layer.weight_by_output, *listed, coarse.tangent, *out, fine.required)
            self._tangents.append(
                _SlabLaunches(tangent_kernel, side, tangents, (fine.tangent,), threads, device)
            )
            self._features.append(fine)
        last, side, corners = self._features[-1], 2 * layers[-1].side, 2 * layers[-1].side + 1
        at_corners = _Mask(corners, empty(corners**3, wp.uint8, device))
        sizes, listed = (side, layers[-1].outputs, out_weight), (last.count, last.channel)
        cube, rows = empty((1, 1, 1), wp.float32, device), empty((1, 1, 1), vec16, device)
        self._occupancy = _SlabLaunches(
            occupancy_kernel,
            corners,
            (*sizes, out_bias, *listed, last.value),
            (at_corners.marks, cube),
            threads,
            device,
        )
        self._jacobian = _SlabLaunches(
            jacobian_kernel, corners, (*sizes, *listed, last.tangent), (cube, rows), threads, device
        )
        # Corners i and i + 1 read voxel i; so do fine voxels 2 i - 1 to 2 i + 2.
        self._propagations = [_propagation((1, 0, 1), at_corners, last.mask, device)]
        for fine, coarse in zip(self._features[:2:-1], self._features[-2:1:-1]):
            self._propagations.append(_propagation((2, -1, 2), fine.mask, coarse.mask, device))

    def decode(
        self,
        total: Float[np.ndarray, "c"],
        tangent: Float[np.ndarray, "c code"],
        grid: wp.array,
        jacobian: wp.array | None,
    ) -> None:
        """Fill the grid and, if given, the Jacobian, from the first layer's output before its ReLU."""
        self._features[0].set_single(total, tangent)
        for layer in self._values:
            layer()
        self._occupancy(grid)
        if jacobian is None:
            return
        for propagation in self._propagations:
            propagation.launch()
        for layer in self._tangents:
            layer()
        self._jacobian(grid, jacobian)


class _SlabLaunches:
    """Recorded launches of a kernel over a cubic grid, one for each slab along x and thread.

    A call sets the kernel's last arguments and runs the launches.
    """

    def __init__(
        self, kernel: Any, side: int, inputs: Sequence[Any], outputs: Sequence[Any], threads: int, device: str
    ) -> None:
        shares = threads if device == "cpu" and side >= _MIN_SHARED_SIDE else 1
        ends = np.linspace(0, side, shares + 1).astype(int).tolist()
        self._arguments = 1 + len(inputs) + len(outputs)
        self._launches = [
            record(kernel, (end - begin, side, side), [begin, *inputs], outputs, device)
            for begin, end in pairwise(ends)
        ]

    def __call__(self, *last: wp.array) -> None:
        run_recorded(self._launches, dict(enumerate(last, start=self._arguments - len(last))))


def _propagation(window: tuple[int, int, int], fine: _Mask, coarse: _Mask, device: str) -> Any:
    """Record the launch that marks the coarse voxels read by marked fine ones.

    With window = (stride, low, high), coarse voxel i is read by the fine voxels stride * i + low to
    stride * i + high.
    """
    sizes = [*window, fine.side, coarse.side]
    return record(propagate_mask_kernel, (coarse.side,) * 3, [*sizes, fine.marks], [coarse.marks], device)
