"""Weights file of the shape prior: safetensors in half precision with metadata of the training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch

from perception.errors import PerceptionError
from perception.io.weights import WEIGHTS_DIRECTORY, load_tensors, read_weights, write_weights
from perception.shape.network import ShapeVae, channels_last

SHIPPED_WEIGHTS = WEIGHTS_DIRECTORY / "shape.safetensors"
FORMAT = "nodeslam-shape-1"
_REMEDY = "restore perception/weights/shape.safetensors from the repository, or run `nodeslam train shape`"


def save_weights(model: ShapeVae, path: Path, metadata: Mapping[str, str]) -> None:
    """Write encoder and decoder in float16, atomically."""
    tensors = {name: value.detach().half().cpu() for name, value in model.state_dict().items()}
    write_weights(path, tensors, {"format": FORMAT, **metadata})


def load_weights(path: Path | None = None, device: str | torch.device = "cpu") -> ShapeVae:
    """Return the trained network in float32, in evaluation mode, without gradients.

    Args:
        path: Weights file; None loads the shipped one.
        device: PyTorch device.

    Raises:
        PerceptionError: The file is missing, corrupt, does not match its checksum or is of another network.
    """
    path = SHIPPED_WEIGHTS if path is None else Path(path)
    tensors, metadata = read_weights(path, _REMEDY, device)
    found = metadata.get("format")
    if found != FORMAT:
        raise PerceptionError(
            f"weights {path} have format {str(found)[:80]!r}, expected {FORMAT!r}; {_REMEDY}"
        )
    with torch.device("meta"):
        model = ShapeVae()
    load_tensors(
        model, {name: tensor.float() for name, tensor in tensors.items()}, path, _REMEDY, assign=True
    )
    channels_last(model, device)
    return model.eval().requires_grad_(False)
