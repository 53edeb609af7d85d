"""Weights files of the detection networks: safetensors with the task in the metadata."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from perception.errors import PerceptionError
from perception.io.weights import load_tensors, read_weights, write_weights

if TYPE_CHECKING:
    from torch import Tensor, nn


def save_weights(tensors: Mapping[str, Tensor], path: Path, about: dict[str, str]) -> None:
    """Write tensors and metadata atomically; missing folders are created."""
    write_weights(path, {name: value.detach().cpu().numpy() for name, value in tensors.items()}, about)


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
    tensors, about = read_task_weights(path, task, command)
    load_tensors(network, tensors, path, remedy(command))
    return about


def read_task_weights(path: Path, task: str, command: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return a file's tensors and metadata; arguments and errors as in ``load_weights``."""
    tensors, about = read_weights(path, remedy(command))
    if about.get("task") != task:
        raise PerceptionError(
            f"weights {path} are for {str(about.get('task'))[:80]!r}, not '{task}'; {remedy(command)}"
        )
    return tensors, about


def temperature_of(about: Mapping[str, str], path: Path) -> float:
    """Return the divisor of the logits that calibrates a network's probabilities.

    Args:
        about: Metadata of the weights file.
        path: Weights file, for the message.

    Raises:
        PerceptionError: It is not a positive number.
    """
    temperature = about.get("temperature", "1.0")
    try:
        if not 0 < float(temperature) < math.inf:
            raise ValueError
    except ValueError:
        raise PerceptionError(f"weights {path}: temperature {temperature[:80]!r} is not positive") from None
    return float(temperature)


def remedy(command: str) -> str:
    """Return what to do about missing or damaged weights, for messages."""
    return f"reinstall the package, or retrain with `nodeslam train {command}`"
