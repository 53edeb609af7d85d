"""Optimised layers equal the plain ones of the paper's architecture."""

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from perception.shape.network import (
    ShapeVae,
    class_bias_maps,
    class_one_hot,
    corner_weight,
    depth_to_space,
)


@pytest.fixture
def model() -> ShapeVae:
    """Weights and biases all different from zero."""
    generator = torch.Generator().manual_seed(3)
    model = ShapeVae().initialise(generator)
    for parameter in model.parameters():
        parameter.data += 0.02 * torch.randn(parameter.shape, generator=generator)
    return model.requires_grad_(False)


def random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("inputs", "outputs", "size"), [(16, 1, 16), (3, 2, 5), (4, 8, 1)])
def test_corner_convolution_is_the_transposed_convolution(inputs, outputs, size):
    x, weight = random(2, inputs, size, size, size), random(inputs, outputs, 4, 4, 4, seed=1)
    plain = F.conv_transpose3d(x, weight, stride=2, padding=1)
    corners = F.conv3d(x, corner_weight(weight), padding=1)
    torch.testing.assert_close(depth_to_space(corners)[:, :, 1:-1, 1:-1, 1:-1], plain, atol=1e-4, rtol=1e-4)


def test_class_bias_maps_are_the_convolution_of_constant_channels():
    weight = random(16, 4, 4, 4, 4)
    maps = class_bias_maps(weight, 32)
    for category in range(4):
        grid = torch.zeros(1, 4, 32, 32, 32)
        grid[:, category] = 1
        plain = F.conv3d(grid, weight, stride=2, padding=1)[0]
        torch.testing.assert_close(maps[category], plain, atol=1e-5, rtol=1e-5)


def test_encoder_equals_the_plain_one(model):
    grids, one_hot = random(3, 32, 32, 32).sigmoid(), class_one_hot(torch.tensor([0, 2, 3]))
    encoder = model.encoder
    x = torch.cat([grids[:, None], one_hot[:, :, None, None, None].expand(-1, -1, 32, 32, 32)], 1)
    for layer in (encoder.conv1, encoder.conv2, encoder.conv3, encoder.conv4):
        x = F.relu(layer(x))
    last = nn.Conv3d(128, 256, 4, stride=2, padding=1).requires_grad_(False)
    last.weight[:, :, 1:3, 1:3, 1:3] = encoder.linear5.weight.reshape(256, 128, 2, 2, 2)
    last.bias = encoder.linear5.bias
    plain = encoder.to_code(F.relu(last(x)).flatten(1))
    mean, log_variance = encoder(grids, one_hot)
    torch.testing.assert_close(torch.cat([mean, log_variance], 1), plain, atol=1e-5, rtol=1e-4)


def test_decoder_equals_the_plain_one(model):
    codes, one_hot = random(2, 16), class_one_hot(torch.tensor([1, 3]))
    decoder = model.decoder
    first = nn.ConvTranspose3d(256, 128, 4, stride=2, padding=1).requires_grad_(False)
    first.weight[:, :, 1:3, 1:3, 1:3] = decoder.linear1.weight.T.reshape(256, 128, 2, 2, 2)
    x = F.relu(decoder.linear0(torch.cat([codes, one_hot], 1)))[:, :, None, None, None]
    x = F.conv_transpose3d(x, first.weight, stride=2, padding=1)
    x = F.relu(x + decoder.linear1.bias.reshape(1, 128, 2, 2, 2))
    for layer in (decoder.up2, decoder.up3, decoder.up4):
        x = F.relu(layer(x))
    plain = F.conv_transpose3d(x, decoder.out_weight, decoder.out_bias, stride=2, padding=1)[:, 0]
    torch.testing.assert_close(decoder(codes, one_hot), plain, atol=1e-5, rtol=1e-4)


def test_forward_samples_around_the_mean(model):
    grids, one_hot = random(2, 32, 32, 32).sigmoid(), class_one_hot(torch.tensor([0, 1]))
    logits, mean, log_variance = model(grids, one_hot, torch.zeros(2, 16))
    torch.testing.assert_close(logits, model.decoder(mean, one_hot))
    moved, *_ = model(grids, one_hot, torch.ones(2, 16))
    torch.testing.assert_close(moved, model.decoder(mean + (0.5 * log_variance).exp(), one_hot))


def test_initial_weights_come_from_the_generator_alone():
    one, two, other = (ShapeVae().initialise(torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters()))
    assert not torch.equal(one.encoder.conv2.weight, other.encoder.conv2.weight)


def test_activations_of_an_untrained_network_are_of_order_one():
    model = ShapeVae().initialise(torch.Generator().manual_seed(0)).requires_grad_(False)
    grids, one_hot = random(4, 32, 32, 32).sigmoid(), class_one_hot(torch.arange(4))
    logits, mean, log_variance = model(grids, one_hot, random(4, 16))
    assert torch.sigmoid(logits).mean() == pytest.approx(0.1, abs=0.05)
    assert mean.abs().max() < 3
    assert log_variance.abs().max() < 3
    assert 0.05 < model.decoder.up4(torch.ones(1, 32, 2, 2, 2)).std() < 5
