"""Weights files of the detection networks: safetensors with the task in the metadata."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from perception.errors import PerceptionError
from perception.io.weights import verify_weights


def save_weights(tensors: dict[str, Tensor], path: Path, about: dict[str, str]) -> None:
    """Write tensors and metadata; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in tensors.items()}, path, metadata=about)


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
    if not path.is_file():
        raise PerceptionError(f"weights {path} are missing; {remedy}")
    verify_weights(path, remedy)
    try:
        with safe_open(path, framework="pt") as file:
            about = file.metadata() or {}
            if about.get("task") != task:
                raise PerceptionError(f"weights {path} are for '{about.get('task')}', not '{task}'; {remedy}")
            network.load_state_dict({name: file.get_tensor(name) for name in file.keys()})  # noqa: SIM118
    except (SafetensorError, RuntimeError, KeyError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise PerceptionError(f"weights {path} cannot be read ({reason}); {remedy}") from error
    return about
