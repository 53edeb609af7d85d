"""Files written whole or not at all, and JSON read with messages a person can act on."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path
from typing import Any

from perception.errors import InvalidInputError


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a whole file or nothing: into a temporary neighbour, then renamed over the target."""
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
    """Write JSON atomically; NaN and infinities, which are no JSON, are refused."""
    write_atomically(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: Path, remedy: str) -> Any:
    """Parse a JSON file.

    Raises:
        InvalidInputError: it is missing or no JSON; the message names the file and ends with the remedy.
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
