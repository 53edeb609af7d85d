"""Atomic writing of files, and reading of JSON with actionable error messages."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from perception.errors import InvalidInputError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file atomically: to a temporary file in the same folder, then renamed over the target."""
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically; raises ValueError for NaN and infinities, which JSON cannot represent."""
    write_atomically(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: Path, remedy: str) -> Any:
    """Parse a JSON file.

    Args:
        path: File to read.
        remedy: What to do about a missing or damaged file, for the message.

    Raises:
        InvalidInputError: The file is missing or not JSON; the message names it and ends with the remedy.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InvalidInputError(f"{path} is missing: {remedy}") from None
    except (OSError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInputError(f"{path} cannot be read ({error}): {remedy}") from None
    except json.JSONDecodeError as error:
        where = f"line {error.lineno} column {error.colno}"
        raise InvalidInputError(f"{path} is not valid JSON ({error.msg} at {where}): {remedy}") from None


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
