"""Weights files of the detection networks: safetensors with the task in the metadata."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor, nn

from perception.errors import PerceptionError
from perception.io.weights import load_tensors, read_weights, write_weights


def save_weights(tensors: dict[str, Tensor], path: Path, about: dict[str, str]) -> None:
    """Write tensors and metadata atomically; missing folders are created."""
    write_weights(path, tensors, about)


def load_weights(network: nn.Module, path: Path, task: str, command: str) -> dict[str, str]:
    """Load weights into a network and return the file's metadata.

    Args:
        network: Network that receives the weights.
        path: Weights file.
        task: Task that the metadata must name.
        command: Name of the job in ``nodeslam train`` that produces such weights, for messages.

    Raises:
        PerceptionError: The file is missing, damaged, differs from its checksum, or is of another network.
    """
    remedy = f"reinstall the package, or retrain with `nodeslam train {command}`"
    tensors, about = read_weights(path, remedy)
    if about.get("task") != task:
        raise PerceptionError(
            f"weights {path} are for {str(about.get('task'))[:80]!r}, not '{task}'; {remedy}"
        )
    load_tensors(network, tensors, path, remedy)
    return about
