"""Weights files of the shape prior: round trip, and messages for unusable files."""

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from perception.errors import PerceptionError
from perception.shape.architecture import DECODER_SHAPES
from perception.shape.decoder import ShapeDecoder
from perception.shape.network import ShapeVae
from perception.shape.weights import (
    SHIPPED_WEIGHTS,
    decoder_weights,
    load_weights,
    read_decoder_weights,
    save_weights,
)


@pytest.fixture
def code() -> np.ndarray:
    return np.random.default_rng(1).standard_normal(16)


def test_weights_survive_the_file(tmp_path, code):
    model = ShapeVae().initialise(torch.Generator().manual_seed(5))
    path = tmp_path / "shape.safetensors"
    save_weights(model, path, {"seed": "5"})
    assert not list(tmp_path.glob("*.tmp"))
    loaded, saved = ShapeDecoder.load(path), ShapeDecoder(decoder_weights(model.decoder))
    np.testing.assert_allclose(loaded("mug", code), saved("mug", code), atol=2e-3, rtol=0)


def test_the_decoder_has_the_parameters_of_the_network():
    read, network = read_decoder_weights(), decoder_weights(load_weights().decoder)
    assert read.keys() == network.keys() == DECODER_SHAPES.keys()
    assert all(np.array_equal(read[name], network[name]) for name in read)


def test_missing_weights_say_what_to_do(tmp_path):
    with pytest.raises(PerceptionError, match=r"nothing\.safetensors are missing; .*nodeslam train shape"):
        ShapeDecoder.load(tmp_path / "nothing.safetensors")


@pytest.mark.parametrize("content", [b"", b"not weights", bytes(100_000)])
def test_corrupt_weights_say_what_to_do(tmp_path, content):
    path = tmp_path / "broken.safetensors"
    path.write_bytes(content)
    with pytest.raises(PerceptionError, match=r"broken\.safetensors cannot be read .*nodeslam train shape"):
        ShapeDecoder.load(path)


def test_truncated_weights_say_what_to_do(tmp_path):
    path = tmp_path / "half.safetensors"
    save_weights(ShapeVae(), path, {})
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(PerceptionError, match="cannot be read"):
        ShapeDecoder.load(path)


def test_weights_of_another_network_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(3)}, path)
    with pytest.raises(PerceptionError, match="format 'None', expected 'nodeslam-shape-1'"):
        ShapeDecoder.load(path)
    save_file({"a": torch.zeros(3)}, path, metadata={"format": "nodeslam-shape-1"})
    with pytest.raises(PerceptionError, match="do not fit the network"):
        ShapeDecoder.load(path)


def test_loading_runs_no_gradients():
    model = load_weights()
    assert not any(parameter.requires_grad for parameter in model.parameters())
    assert not model.training


def test_shipped_weights_are_small():
    assert SHIPPED_WEIGHTS.stat().st_size < 12e6


def test_files_hold_half_precision_and_their_metadata(tmp_path):
    path = tmp_path / "shape.safetensors"
    save_weights(ShapeVae(), path, {"seed": "5"})
    with safe_open(path, framework="pt") as file:
        assert file.metadata() == {"format": "nodeslam-shape-1", "seed": "5"}
        assert {file.get_tensor(name).dtype for name in file.keys()} == {torch.float16}  # noqa: SIM118
    assert {parameter.dtype for parameter in load_weights(path).parameters()} == {torch.float32}
