"""Files of training jobs beside weights: arrays of rendered data, TensorBoard curves, checksums."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perception.errors import PerceptionError, install_hint
from perception.io.arrays import read_arrays
from perception.io.weights import weights_checksum


def packed_arrays(holder: Any, names: Sequence[str]) -> bytes:
    """Return the named array attributes of an object as the content of an npz file."""
    file = io.BytesIO()
    np.savez(file, **{name: getattr(holder, name) for name in names})
    return file.getvalue()


def load_arrays(path: Path, names: Sequence[str], what: str) -> dict[str, np.ndarray]:
    """Read the named arrays of an npz file; ``what`` names the expected content in the error message.

    Raises:
        PerceptionError: The file is damaged, or lacks an array.
    """
    try:
        arrays = read_arrays(path)
        return {name: arrays[name] for name in names}
    except (OSError, KeyError, ValueError) as error:
        raise PerceptionError(f"{path} holds no {what} ({error}); delete it and train again") from error


def summary_writer(folder: Path) -> Any:
    """Return a TensorBoard writer.

    Raises:
        PerceptionError: TensorBoard is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise PerceptionError(
            f"TensorBoard is not installed: {install_hint('train')}, or leave out --tensorboard"
        ) from error
    return SummaryWriter(str(folder))


def checksums(*weights: Path) -> str:
    """Return the last line of a model card: the digest of each weights file."""
    return "\n" + ", ".join(f"SHA-256 of `{path.name}` `{weights_checksum(path)}`" for path in weights) + "\n"
