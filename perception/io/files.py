"""Atomic writing of files; bounded reading of regular files and of JSON with actionable error messages.

Every input file is read by ``read_bytes``, so that no pipe, device or oversized file blocks the program.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import stat
import tempfile
from pathlib import Path
from typing import Any

from perception.errors import InvalidInputError

MAX_JSON_BYTES = MAX_TEXT_BYTES = 256 * 2**20
MAX_DIGITS = 18  # of an integer in a JSON file: all fit into 64 bits
_SURROGATE = re.compile(rb"\\u[dD][89a-fA-F]")
_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write a file atomically: to a temporary file in the same folder, then renamed over the target.

    Raises:
        InvalidInputError: The target is a folder, pipe, socket or device, which would be replaced.
        OSError: It cannot be written.
    """
    with contextlib.suppress(FileNotFoundError):
        _check_regular(path, os.stat(path))
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
    """Write JSON atomically; raises ValueError for NaN and infinities, which JSON cannot represent.

    What is no Unicode, such as in names of files that were made in another encoding, becomes question marks.
    """
    text = json.dumps(value, indent=1, allow_nan=False)
    if _SURROGATE.search(text.encode()):
        text = json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, text.encode(errors="replace") + b"\n")


def check_regular(path: Path, max_bytes: int) -> None:
    """Check that a path leads to a regular file of at most the given size, without opening it.

    Raises:
        InvalidInputError: It is something else, or larger.
        OSError: It is missing or inaccessible.
    """
    _check_status(path, os.stat(path), max_bytes)


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of at most the given size; symbolic links are followed.

    Raises:
        InvalidInputError: It is a folder, pipe, socket or device, or larger.
        OSError: It is missing or cannot be read.
    """
    check_regular(path, max_bytes)
    handle = os.open(
        path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
    )  # a pipe put there by now does not block
    with os.fdopen(handle, "rb") as file:
        _check_status(path, os.fstat(handle), max_bytes)
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:  # the size of files in /proc is unknown, others may grow
        raise InvalidInputError(_too_large(path, f"more than {max_bytes}", max_bytes))
    return content


def read_text(path: Path) -> str:
    """Read a regular text file of at most MAX_TEXT_BYTES in UTF-8, with or without byte order mark.

    Raises:
        InvalidInputError: It is not a regular file, or larger.
        OSError, UnicodeDecodeError: It is missing, cannot be read, or is not UTF-8.
    """
    return read_bytes(path, MAX_TEXT_BYTES).decode("utf-8-sig")


def read_json(path: Path, remedy: str) -> Any:
    """Parse a JSON file.

    Args:
        path: File to read.
        remedy: What to do about a missing or damaged file, for the message.

    Raises:
        InvalidInputError: The file is missing, not regular, too large or not JSON, is nested too deeply, or
            holds a number that is too large; the message names it and ends with the remedy.
    """
    try:
        return parse_json(read_bytes(path, MAX_JSON_BYTES))
    except InvalidInputError as error:
        raise InvalidInputError(f"{error}: {remedy}") from None
    except FileNotFoundError:
        raise InvalidInputError(f"{path} is missing: {remedy}") from None
    except OSError as error:
        raise InvalidInputError(f"{path} cannot be read ({error}): {remedy}") from None
    except ValueError as error:
        raise InvalidInputError(f"{path} {error}: {remedy}") from None


def parse_json(data: bytes, nan_allowed: bool = False) -> Any:
    """Parse JSON in UTF-8, with or without byte order mark; NaN and infinity are no JSON, but may be allowed.

    Raises:
        ValueError: It is not JSON, is nested too deeply, or holds NaN, a number that is too large, a name
            twice in one object, or text that cannot be encoded; the message continues a sentence that
            begins with the name of the file.
    """
    try:
        value = json.loads(
            data.decode("utf-8-sig"),
            parse_int=_integer,
            parse_float=_real,
            parse_constant=float if nan_allowed else _constant,
            object_pairs_hook=_object,
        )
        if _SURROGATE.search(data):
            json.dumps(value, ensure_ascii=False).encode()  # fails if one of a pair is alone
        return value
    except RecursionError:
        raise ValueError("cannot be read (nested too deeply)") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot be read ({error})") from None
    except UnicodeEncodeError:
        raise ValueError("holds text that is no Unicode (half of a surrogate pair)") from None
    except json.JSONDecodeError as error:
        where = f"line {error.lineno} column {error.colno}"
        raise ValueError(f"is not valid JSON ({error.msg} at {where})") from None


def _integer(text: str) -> int:
    digits = len(text.lstrip("-"))
    if digits > MAX_DIGITS:
        raise ValueError(f"holds an integer of {digits} digits, at most {MAX_DIGITS} are supported")
    return int(text)


def _real(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"holds the number {text[:30]}, which is too large")
    return value


def _constant(name: str) -> float:
    raise ValueError(f"holds {name}, which is no number in JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for name, entry in pairs:
        if name in value:
            raise ValueError(f"holds the name {name[:80]!r} twice in one object")
        value[name] = entry
    return value


def _check_status(path: Path, status: os.stat_result, max_bytes: int) -> None:
    _check_regular(path, status)
    if status.st_size > max_bytes:
        raise InvalidInputError(_too_large(path, str(status.st_size), max_bytes))


def _check_regular(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = _KINDS.get(stat.S_IFMT(status.st_mode), "something else")
        raise InvalidInputError(f"{path} is {kind}, not a regular file")


def _too_large(path: Path, size: str, max_bytes: int) -> str:
    return f"{path} is too large ({size} bytes; at most {max_bytes} are read)"


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
