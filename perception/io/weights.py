"""Weights files on disk: location of the shipped ones, checksums, validated reading, and writing.

``SHA256SUMS`` beside the weights holds one digest per file, as ``sha256sum`` writes and checks it.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perception.errors import PerceptionError
from perception.io.files import check_regular, read_text, write_atomically

if TYPE_CHECKING:
    import torch

WEIGHTS_DIRECTORY = Path(__file__).parents[1] / "weights"
CHECKSUMS_FILE = "SHA256SUMS"
MAX_WEIGHTS_BYTES = 4 * 2**30
_NUMBERS = {"F16", "F32", "F64", "I64"}  # types of numbers, as safetensors names them
_LENGTH_BYTES = 8  # of the header of a safetensors file


def weights_checksum(path: Path) -> str:
    """Return the SHA-256 digest of a file in lower-case hexadecimal."""
    check_regular(path, MAX_WEIGHTS_BYTES)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def expected_checksum(path: Path) -> str | None:
    """Return the digest listed for a weights file, or None for weights outside a folder with checksums.

    Raises:
        PerceptionError: the folder's checksums do not list the file, or the shipped folder has no checksums.
    """
    sums = path.parent / CHECKSUMS_FILE
    if not sums.is_file():
        if path.parent.resolve() == WEIGHTS_DIRECTORY.resolve():
            raise PerceptionError(f"{sums} is missing; restore it from the repository")
        return None
    for line in read_text(sums).splitlines():
        digest, _, name = line.partition(" ")
        if name.strip().removeprefix("*") == path.name:
            return digest.lower()
    raise PerceptionError(
        f"{sums} lists no checksum for {path.name}; if the weights are your own, "
        f"add the line printed by `sha256sum {path.name}`"
    )


def verify_weights(path: Path, remedy: str) -> None:
    """Compare a weights file with the checksum listed beside it; weights without checksums are accepted.

    Args:
        path: weights file, which must exist.
        remedy: what to do about damaged weights, for the message.

    Raises:
        PerceptionError: the file cannot be read, differs from its checksum, or has none where it must.
    """
    try:
        expected = expected_checksum(path)
        matches = expected is None or weights_checksum(path) == expected
    except (OSError, UnicodeDecodeError) as error:
        raise PerceptionError(f"weights {path} cannot be read ({error}); {remedy}") from error
    if not matches:
        raise PerceptionError(f"weights {path} differ from their checksum in {CHECKSUMS_FILE}; {remedy}")


def read_weights(path: Path, remedy: str) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return the tensors and the metadata of a safetensors file.

    Args:
        path: weights file.
        remedy: what to do about missing or damaged weights, for the message.

    Raises:
        PerceptionError: the file is missing, damaged, differs from its checksum, or holds numbers that are
            not finite.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise PerceptionError(f"weights {path} are missing; {remedy}")
    verify_weights(path, remedy)
    try:
        with safe_open(path, framework="numpy") as file:
            kinds = {name: str(file.get_slice(name).get_dtype()) for name in file.keys()}  # noqa: SIM118
            tensors = {name: file.get_tensor(name) for name, kind in kinds.items() if kind in _NUMBERS}
            metadata = file.metadata() or {}
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise PerceptionError(f"weights {path} cannot be read ({error}); {remedy}") from error
    for name, kind in kinds.items():
        if kind not in _NUMBERS:
            raise PerceptionError(f"weights {path}: '{name}' holds {kind} numbers; {remedy}")
        if not np.isfinite(tensors[name]).all():
            raise PerceptionError(f"weights {path}: '{name}' holds numbers that are not finite; {remedy}")
    return tensors, metadata


def write_weights(path: Path, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file atomically; the same content gives the same bytes.

    The library writes the metadata in random order, so that digests of equal weights would differ.
    """
    from safetensors.numpy import save

    # ascontiguousarray would give scalars, such as the counters of batch normalisations, a dimension
    content = save({name: np.asarray(tensor, order="C") for name, tensor in tensors.items()}, dict(metadata))
    begin = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    header = json.loads(content[_LENGTH_BYTES:begin]) | {"__metadata__": dict(sorted(metadata.items()))}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH_BYTES)  # tensors are aligned
    write_atomically(path, len(text).to_bytes(_LENGTH_BYTES, "little") + text + content[begin:])


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write the state of a training atomically, to be read with ``torch.load(..., weights_only=True)``."""
    import torch

    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue())


def check_shapes(
    tensors: Mapping[str, np.ndarray], expected: Mapping[str, tuple[int, ...]], path: Path, remedy: str
) -> None:
    """Check that a network's parameters are complete and of their shapes.

    Raises:
        PerceptionError: they belong to another network; the message names the first difference.
    """
    for name in [*expected, *(name for name in tensors if name not in expected)]:
        found = tensors[name].shape if name in tensors else None
        if found != expected.get(name):
            reason = f"'{name[:80]}' is {found or 'missing'}, expected {expected.get(name, 'nothing')}"
            raise PerceptionError(f"weights {path} do not fit the network ({reason}); {remedy}")


def load_tensors(
    network: torch.nn.Module, tensors: Mapping[str, np.ndarray], path: Path, remedy: str, assign: bool = False
) -> None:
    """Load tensors into a network; with ``assign`` they become its parameters.

    Raises:
        PerceptionError: they belong to another network; the message names the first difference.
    """
    import torch

    try:
        network.load_state_dict(
            {name: torch.from_numpy(value) for name, value in tensors.items()}, assign=assign
        )
    except RuntimeError as error:
        _, *differences = (line.strip() for line in str(error).splitlines())  # after the title
        reason = (differences[0] if differences else str(error))[:200]
        raise PerceptionError(f"weights {path} do not fit the network ({reason}); {remedy}") from error
