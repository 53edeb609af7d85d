"""Weights of the detection networks on disk: safetensors, with what they are for in the metadata."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from perception.errors import PerceptionError
from perception.io.weights import verify_weights


def save_weights(tensors: dict[str, Tensor], path: Path, about: dict[str, str]) -> None:
    """Write tensors with metadata; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_file({name: value.contiguous() for name, value in tensors.items()}, path, metadata=about)


def load_weights(network: nn.Module, path: Path, task: str, command: str) -> dict[str, str]:
    """Put the weights of a file into a network; returns the metadata.

    Args:
        task: what the file must be for.
        command: ``nodeslam train <command>`` makes such weights.

    Raises:
        PerceptionError: the file is missing, damaged, unlike its checksum, or holds another network.
    """
    remedy = f"reinstall the package, or train them anew with `nodeslam train {command}`"
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
