"""The sparse decoder against the dense network and its forward-mode derivatives."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from perception.shape.network import ShapeVae
from perception.shape.sparse_decoder import SparseDecoder
from perception.shape.weights import decoder_weights


@pytest.fixture(scope="module")
def network():
    """Random weights and biases; outputs from saturated to undecided."""
    generator = torch.Generator().manual_seed(2)
    decoder = ShapeVae().initialise(generator).decoder
    for parameter in decoder.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    decoder.out_weight.data *= 20
    return decoder.eval().requires_grad_(False)


@pytest.fixture(scope="module")
def sparse(network):
    return SparseDecoder(decoder_weights(network), "cpu")


def dense(network, code, category):
    one_hot = torch.eye(4)[category][None]
    function = lambda c: torch.sigmoid(network(c[None], one_hot)[0])  # noqa: E731
    return function(torch.from_numpy(code)), torch.func.jacfwd(function)(torch.from_numpy(code))


def codes(n: int) -> np.ndarray:
    return np.random.default_rng(3).normal(size=(n, 16)).astype(np.float32)


@pytest.mark.parametrize("category", [0, 3])
def test_grid_and_jacobian_equal_those_of_the_dense_network(network, sparse, category):
    code = codes(1)[0]
    grid, jacobian = (torch.from_numpy(part) for part in sparse(code, category, True))
    expected, derivative = dense(network, code, category)
    torch.testing.assert_close(grid, expected, atol=2e-6, rtol=1e-4)
    slope = expected * (1 - expected)
    steep = slope > 1.01e-4
    assert 0.1 < steep.float().mean() < 0.95
    scale = float(derivative.abs().max())
    torch.testing.assert_close(jacobian[steep], derivative[steep], atol=1e-5 * scale, rtol=1e-3)
    assert not jacobian[slope < 0.99e-4].any()


def test_memory_of_another_code_is_not_reused(sparse):
    first, second = codes(2)
    grid, jacobian = sparse(first, 1, True)
    sparse(second, 2, True)
    again = sparse(first, 1, True)
    assert np.array_equal(again[0], grid) and np.array_equal(again[1], jacobian)


def test_without_the_jacobian_the_grid_is_the_same(sparse):
    code = codes(1)[0]
    grid, jacobian = sparse(code, 0, False)
    assert jacobian is None and np.array_equal(grid, sparse(code, 0, True)[0])


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_does_not_change_the_result(sparse, threads):
    code = codes(1)[0]
    for shared, alone in zip(sparse(code, 1, True, threads), sparse(code, 1, True), strict=True):
        assert np.array_equal(shared, alone)


def test_concurrent_calls_have_memory_of_their_own(sparse):
    inputs = codes(6)
    alone = [sparse(code, 0, True) for code in inputs]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda code: sparse(code, 0, True), inputs))
    for a, b in zip(alone, together, strict=True):
        assert np.array_equal(a[0], b[0]) and np.array_equal(a[1], b[1])
