"""Each kernel of the sparse decoder against dense convolutions or loops in NumPy."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
import warp as wp

from perception.shape.sparse_kernels import (
    jacobian_kernel,
    occupancy_kernel,
    propagate_mask_kernel,
    tangent_kernel,
    value_kernel,
    vec8,
    vec16,
)
from perception.warp_runtime import launch, to_device, zeros

SIDE, INPUTS, OUTPUTS = 3, 16, 32


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def features(side: int, channels: int):
    """Return random values after a ReLU and derivatives that are zero where it is inactive."""
    values = np.maximum(rng(1).normal(size=(side, side, side, channels)), 0).astype(np.float32)
    tangents = rng(2).normal(size=(*values.shape, 16)).astype(np.float32) * (values > 0)[..., None]
    return values, tangents


def compact(values, tangents):
    """Count, channels, values and derivatives of the active channels, as device arrays."""
    channels = values.shape[-1]
    rows, row_tangents = values.reshape(-1, channels), tangents.reshape(-1, channels, 16)
    count = (rows > 0).sum(1)
    channel = np.zeros(rows.shape, np.int32)
    value, tangent = np.zeros_like(rows), np.full_like(row_tangents, np.nan)
    for at, row in enumerate(rows):
        active = np.flatnonzero(row)
        channel[at, : len(active)], value[at, : len(active)] = active, row[active]
        tangent[at, : len(active)] = row_tangents[at, active]
    return (
        to_device(count, wp.int32, "cpu"),
        to_device(channel.ravel(), wp.int32, "cpu"),
        to_device(value.ravel(), wp.float32, "cpu"),
        to_device(tangent.reshape(-1, 16), vec16, "cpu"),
    )


@pytest.fixture(scope="module")
def layer():
    weight = rng(3).normal(size=(INPUTS, OUTPUTS, 4, 4, 4)).astype(np.float32) / 10
    return weight, rng(4).normal(size=OUTPUTS).astype(np.float32) / 10


def transposed(x: np.ndarray, weight: np.ndarray, bias: np.ndarray | None) -> np.ndarray:
    """Dense transposed convolution with channels last."""
    tensor = torch.from_numpy(x).permute(3, 0, 1, 2)[None]
    plain = F.conv_transpose3d(
        tensor,
        torch.from_numpy(weight),
        None if bias is None else torch.from_numpy(bias),
        stride=2,
        padding=1,
    )
    return plain[0].permute(1, 2, 3, 0).numpy()


def computed_values(layer, inputs, bias_rows: int = 1):
    weight, bias = layer
    taps = weight.reshape(INPUTS, OUTPUTS, 64)
    fine = 2 * SIDE
    out = [
        zeros(fine**3, wp.int32, "cpu"),
        zeros(fine**3 * OUTPUTS, wp.int32, "cpu"),
        zeros(fine**3 * OUTPUTS, wp.float32, "cpu"),
    ]
    rows = np.tile(bias, (bias_rows, 1)) + 0.01 * np.arange(bias_rows)[:, None]
    arguments = [
        to_device(taps.transpose(2, 0, 1).reshape(-1, 16), vec16, "cpu"),
        to_device(rows.astype(np.float32).reshape(-1, 16), vec16, "cpu"),
        bias_rows,
    ]
    launch(value_kernel, (fine,) * 3, [0, SIDE, INPUTS, OUTPUTS, *arguments, *inputs[:3]], out, "cpu")
    return out


@pytest.mark.parametrize("bias_rows", [1, 216])
def test_values_are_those_of_the_transposed_convolution_and_relu(layer, bias_rows):
    values, tangents = features(SIDE, INPUTS)
    count, channel, value = (a.numpy() for a in computed_values(layer, compact(values, tangents), bias_rows))
    plain = transposed(values, *layer).reshape(-1, OUTPUTS) + 0.01 * (np.arange(216)[:, None] % bias_rows)
    assert (plain > 0).mean() > 0.2
    for at, row in enumerate(plain):
        active = np.flatnonzero(row > 0)
        begin = at * OUTPUTS
        assert count[at] == len(active)
        assert channel[begin : begin + len(active)].tolist() == active.tolist()
        np.testing.assert_allclose(value[begin : begin + len(active)], row[active], atol=2e-5)


def test_tangents_of_active_channels_at_required_voxels(layer):
    values, tangents = features(SIDE, INPUTS)
    inputs = compact(values, tangents)
    count, channel, _ = computed_values(layer, inputs)
    weight = layer[0]
    required = (rng(5).random(216) < 0.5).astype(np.uint8)
    out = to_device(np.full((216 * OUTPUTS, 16), 7.0), vec16, "cpu")
    by_output = weight.reshape(INPUTS, OUTPUTS, 64).transpose(2, 1, 0).ravel()
    arguments = [0, SIDE, INPUTS, OUTPUTS, to_device(by_output, wp.float32, "cpu"), *inputs[:2], inputs[3]]
    mask = to_device(required, wp.uint8, "cpu")
    launch(tangent_kernel, (2 * SIDE,) * 3, [*arguments, count, channel, mask], [out], "cpu")
    found = out.numpy().reshape(216, OUTPUTS, 16)
    plain = np.stack([transposed(tangents[..., k], weight, None) for k in range(16)], axis=-1)
    plain = plain.reshape(216, OUTPUTS, 16)
    for at in range(216):
        n = count.numpy()[at]
        if required[at]:
            active = channel.numpy()[at * OUTPUTS : at * OUTPUTS + n]
            np.testing.assert_allclose(found[at, :n], plain[at, active], atol=5e-5)
        else:
            assert (found[at] == 7.0).all()


@pytest.fixture(scope="module")
def last_layer():
    """Weights (16, 1, 4, 4, 4) large enough to saturate half of the voxels, and a bias."""
    return rng(6).normal(size=(INPUTS, 1, 4, 4, 4)).astype(np.float32), -0.7


def by_neighbour(weight: np.ndarray) -> wp.array:
    """[neighbour, input] vectors of the eight phases: tap = phase + 2 neighbour along each axis."""
    split = weight.reshape(INPUTS, 2, 2, 2, 2, 2, 2).transpose(1, 3, 5, 0, 2, 4, 6)
    return to_device(split.reshape(-1, 8), vec8, "cpu")


def decoded(last_layer, inputs):
    weight, bias = last_layer
    corners, fine = SIDE + 1, 2 * SIDE
    marks, grid = zeros(corners**3, wp.uint8, "cpu"), zeros((fine,) * 3, wp.float32, "cpu")
    arguments = [0, SIDE, INPUTS, by_neighbour(weight), bias, *inputs[:3]]
    launch(occupancy_kernel, (corners,) * 3, arguments, [marks, grid], "cpu")
    return marks.numpy().reshape((corners,) * 3), grid


def test_occupancies_are_those_of_the_transposed_convolution_and_sigmoid(last_layer):
    values, tangents = features(SIDE, INPUTS)
    marks, grid = decoded(last_layer, compact(values, tangents))
    weight, bias = last_layer
    plain = 1 / (1 + np.exp(-transposed(values, weight, np.array([bias], np.float32))[..., 0].astype(float)))
    np.testing.assert_allclose(grid.numpy(), plain, atol=2e-6)
    slope = np.pad(plain * (1 - plain), 1)  # corner c is between the fine voxels 2c - 1 and 2c
    steepest = slope.reshape(4, 2, 4, 2, 4, 2).max((1, 3, 5))
    assert (steepest > 1e-4).mean() > 0
    np.testing.assert_array_equal(marks, steepest > 1e-4)


def test_corners_of_saturated_voxels_are_not_marked(last_layer):
    values, tangents = features(SIDE, INPUTS)
    weight, _ = last_layer
    marks, grid = decoded((weight, -1000.0), compact(values, tangents))
    assert not marks.any() and not grid.numpy().any()


def test_jacobian_is_the_slope_times_the_transposed_convolution_of_the_tangents(last_layer):
    values, tangents = features(SIDE, INPUTS)
    inputs = compact(values, tangents)
    weight, _ = last_layer
    _, grid = decoded(last_layer, inputs)
    out = zeros((2 * SIDE,) * 3, vec16, "cpu")
    arguments = [0, SIDE, INPUTS, by_neighbour(weight), *inputs[:2], inputs[3]]
    launch(jacobian_kernel, (SIDE + 1,) * 3, [*arguments, grid], [out], "cpu")
    o = grid.numpy().astype(float)
    slope = np.where(o * (1 - o) > 1e-4, o * (1 - o), 0.0)
    plain = np.stack([transposed(tangents[..., k], weight, None)[..., 0] for k in range(16)], axis=-1)
    assert (slope > 0).any() and (slope == 0).any()
    np.testing.assert_allclose(out.numpy(), slope[..., None] * plain, atol=2e-5)


@pytest.mark.parametrize(("stride", "low", "high", "fine_side"), [(2, -1, 2, 8), (1, 0, 1, 5)])
def test_marks_propagate_to_the_voxels_that_are_read(stride, low, high, fine_side):
    side = 4
    fine = (rng(7).random((fine_side,) * 3) < 0.03).astype(np.uint8)
    marks = to_device(np.full(side**3, 9), wp.uint8, "cpu")
    inputs = [stride, low, high, fine_side, side, to_device(fine.ravel(), wp.uint8, "cpu")]
    launch(propagate_mask_kernel, (side,) * 3, inputs, [marks], "cpu")
    expected = np.zeros((side,) * 3)
    for voxel in np.ndindex(expected.shape):
        window = tuple(slice(max(stride * i + low, 0), stride * i + high + 1) for i in voxel)
        expected[voxel] = fine[window].any()
    assert 0 < expected.mean() < 1
    np.testing.assert_array_equal(marks.numpy().reshape(expected.shape), expected)
