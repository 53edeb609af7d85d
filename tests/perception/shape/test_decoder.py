"""Values and derivatives of the decoder."""

import numpy as np
import pytest
import torch

from perception.errors import InvalidInputError
from perception.shape.decoder import ShapeDecoder
from perception.shape.network import DecoderNetwork, ShapeVae
from perception.shape.weights import decoder_weights
from perception.types import CATEGORIES


@pytest.fixture(scope="module")
def network() -> DecoderNetwork:
    """Random weights, with biases, and outputs that do not saturate."""
    generator = torch.Generator().manual_seed(0)
    model = ShapeVae().initialise(generator)
    for parameter in model.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    return model.decoder


@pytest.fixture(scope="module")
def decoder(network) -> ShapeDecoder:
    return ShapeDecoder(decoder_weights(network))


@pytest.fixture
def code() -> np.ndarray:
    return torch.randn(16, generator=torch.Generator().manual_seed(1)).numpy()


@pytest.mark.parametrize("category", CATEGORIES)
def test_jacobian_equals_forward_mode_autograd(network, decoder, code, category):
    one_hot = torch.eye(4)[[CATEGORIES.index(category)]]

    def dense(c):
        return torch.sigmoid(network(c[None], one_hot)[0])

    grid, jacobian = decoder.with_jacobian(category, code)
    expected = torch.func.jacfwd(dense)(torch.from_numpy(code)).detach().numpy()
    assert jacobian.shape == (32, 32, 32, 16)
    assert grid.dtype == jacobian.dtype == np.float32
    assert jacobian.flags.c_contiguous
    np.testing.assert_allclose(grid, dense(torch.from_numpy(code)).detach().numpy(), atol=2e-6, rtol=1e-5)
    np.testing.assert_allclose(jacobian, expected, atol=1e-5 * float(np.abs(expected).max()), rtol=1e-4)


def test_jacobian_equals_finite_differences(decoder, code):
    _, jacobian = decoder.with_jacobian("bowl", code)
    step = 1e-3
    for k in (0, 7, 15):
        direction = step * np.eye(16, dtype=np.float32)[k]
        difference = (decoder("bowl", code + direction) - decoder("bowl", code - direction)) / (2 * step)
        error = difference - jacobian[..., k]  # differs where the step crosses the kink of a ReLU
        assert np.linalg.norm(error) < 0.02 * np.linalg.norm(jacobian[..., k])


def test_the_grid_is_the_same_with_and_without_jacobian_and_in_both_precisions(decoder, code):
    grid, jacobian = decoder.with_jacobian("mug", code.astype(np.float64))
    np.testing.assert_array_equal(decoder("mug", code), grid)
    assert jacobian.dtype == np.float32


def test_wrong_arguments_are_named(decoder):
    with pytest.raises(InvalidInputError, match=r"\(17,\), expected \(16,\)"):
        decoder("mug", np.zeros(17))
    with pytest.raises(InvalidInputError, match=r"\(15,\), expected \(16,\)"):
        decoder.with_jacobian("mug", np.zeros(15))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_jacobian_on_cuda_equals_the_one_on_cpu(code):
    on_cpu = ShapeDecoder.load().with_jacobian("mug", code)
    on_cuda = ShapeDecoder.load(device="cuda").with_jacobian("mug", code)
    for a, b in zip(on_cpu, on_cuda):
        np.testing.assert_allclose(a, b, atol=1e-3, rtol=1e-3)
