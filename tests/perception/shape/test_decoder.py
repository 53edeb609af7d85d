"""Values and derivatives of the decoder."""

import numpy as np
import pytest
import torch

from perception.errors import InvalidInputError
from perception.shape.decoder import ShapeDecoder
from perception.shape.network import ShapeVae
from perception.types import CATEGORIES


@pytest.fixture(scope="module")
def decoder() -> ShapeDecoder:
    """Random weights, with biases, and outputs that do not saturate."""
    generator = torch.Generator().manual_seed(0)
    model = ShapeVae().initialise(generator)
    for parameter in model.parameters():
        parameter.data += 0.05 * torch.randn(parameter.shape, generator=generator)
    return ShapeDecoder(model.decoder)


@pytest.fixture
def code() -> torch.Tensor:
    return torch.randn(16, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("category", CATEGORIES)
def test_jacobian_equals_forward_mode_autograd(decoder, code, category):
    grid, jacobian = decoder.with_jacobian(category, code)
    expected = torch.func.jacfwd(lambda c: decoder(category, c[None])[0])(code)
    assert jacobian.shape == (32, 32, 32, 16)
    assert jacobian.dtype == torch.float32
    assert jacobian.is_contiguous()
    torch.testing.assert_close(grid, decoder(category, code[None])[0], atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(jacobian, expected, atol=1e-5 * float(expected.abs().max()), rtol=1e-4)


def test_jacobian_equals_finite_differences(decoder, code):
    _, jacobian = decoder.with_jacobian("bowl", code)
    step = 1e-3
    for k in (0, 7, 15):
        direction = step * torch.eye(16)[k]
        ends = decoder("bowl", torch.stack([code + direction, code - direction]))
        difference = (ends[0] - ends[1]) / (2 * step)
        error = difference - jacobian[..., k]  # differs where the step crosses the kink of a ReLU
        assert error.norm() < 0.02 * jacobian[..., k].norm()


def test_sigmoid_of_the_logits_is_the_occupancy(decoder, code):
    codes = torch.stack([code, -code])
    torch.testing.assert_close(torch.sigmoid(decoder.logits("can", codes)), decoder("can", codes))
    assert decoder("can", codes).shape == (2, 32, 32, 32)


def test_codes_may_be_numpy_arrays(decoder, code):
    torch.testing.assert_close(decoder("mug", code.numpy()[None]), decoder("mug", code[None]))
    assert decoder.with_jacobian("mug", code.numpy().astype(np.float64))[1].dtype == torch.float32


def test_occupancies_can_be_differentiated_by_autograd(decoder, code):
    code.requires_grad_(True)
    decoder("mug", code[None]).sum().backward()
    assert code.grad is not None
    expected = decoder.with_jacobian("mug", code.detach())[1].sum((0, 1, 2))
    torch.testing.assert_close(code.grad, expected, rtol=1e-3, atol=1e-3)


def test_wrong_arguments_are_named(decoder):
    with pytest.raises(InvalidInputError, match=r"\(1, 15\), expected \(batch, 16\)"):
        decoder("mug", torch.zeros(1, 15))
    with pytest.raises(InvalidInputError, match=r"\(15,\), expected \(16,\)"):
        decoder.with_jacobian("mug", torch.zeros(15))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_jacobian_on_cuda_equals_the_one_on_cpu(code):
    on_cpu = ShapeDecoder.load().with_jacobian("mug", code)
    on_cuda = ShapeDecoder.load(device="cuda").with_jacobian("mug", code)
    for a, b in zip(on_cpu, on_cuda):
        assert b.is_cuda
        torch.testing.assert_close(a, b.cpu(), atol=1e-3, rtol=1e-3)
