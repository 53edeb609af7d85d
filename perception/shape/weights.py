"""Weights file of the shape prior: safetensors in half precision with metadata of the training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from perception.errors import PerceptionError
from perception.io.weights import (
    WEIGHTS_DIRECTORY,
    check_shapes,
    load_tensors,
    read_weights,
    write_weights,
)
from perception.shape.architecture import DECODER_SHAPES

if TYPE_CHECKING:
    import torch

    from perception.shape.network import DecoderNetwork, ShapeVae

SHIPPED_WEIGHTS = WEIGHTS_DIRECTORY / "shape.safetensors"
FORMAT = "nodeslam-shape-1"
_REMEDY = "restore perception/weights/shape.safetensors from the repository, or run `nodeslam train shape`"
_DECODER = "decoder."


def save_weights(model: ShapeVae, path: Path, metadata: Mapping[str, str]) -> None:
    """Write encoder and decoder in float16, atomically."""
    tensors = {name: value.detach().half().cpu().numpy() for name, value in model.state_dict().items()}
    write_weights(path, tensors, {"format": FORMAT, **metadata})


def load_weights(path: Path | None = None, device: str | torch.device = "cpu") -> ShapeVae:
    """Return the trained network in float32, in evaluation mode, without gradients.

    Args:
        path: Weights file; None loads the shipped one.
        device: PyTorch device.

    Raises:
        PerceptionError: The file is missing, corrupt, does not match its checksum or is of another network.
    """
    import torch

    from perception.shape.network import ShapeVae, channels_last

    path = SHIPPED_WEIGHTS if path is None else path
    tensors = _read(path)
    with torch.device("meta"):
        model = ShapeVae()
    load_tensors(model, tensors, path, _REMEDY, assign=True)
    channels_last(model, device)
    return model.eval().requires_grad_(False)


def read_decoder_weights(path: Path | None = None) -> dict[str, np.ndarray]:
    """Return the decoder's parameters in float32 by name; arguments and errors as in ``load_weights``."""
    path = SHIPPED_WEIGHTS if path is None else path
    tensors = {
        name.removeprefix(_DECODER): value for name, value in _read(path).items() if name.startswith(_DECODER)
    }
    check_shapes(tensors, DECODER_SHAPES, path, _REMEDY)
    return tensors


def decoder_weights(network: DecoderNetwork) -> dict[str, np.ndarray]:
    """Return the parameters of a network as ``read_decoder_weights`` does."""
    return {name: value.detach().float().cpu().numpy() for name, value in network.state_dict().items()}


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return all tensors of a file of this format in float32."""
    tensors, metadata = read_weights(path, _REMEDY)
    found = metadata.get("format")
    if found != FORMAT:
        raise PerceptionError(
            f"weights {path} have format {str(found)[:80]!r}, expected {FORMAT!r}; {_REMEDY}"
        )
    return {name: tensor.astype(np.float32) for name, tensor in tensors.items()}
