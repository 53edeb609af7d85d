"""NumPy files (npz, npy): bounded reading, without pickles; arrays of numbers in JSON."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format

from perception.io.files import read_bytes

MAX_ARRAY_BYTES = 4 * 2**30  # of a file, and of its arrays once unpacked


def read_arrays(path: Path, max_bytes: int = MAX_ARRAY_BYTES) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file.

    Raises:
        ValueError: The file is not regular, too large or damaged, holds objects, or unpacks to more than
            ``max_bytes``; an ``InvalidInputError`` is one.
        OSError: It is missing or cannot be read.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path, max_bytes))) as archive:
            if sum(member.file_size for member in archive.infolist()) > max_bytes:
                raise ValueError(f"its arrays are larger than {max_bytes} bytes")
            return {
                member.filename.removesuffix(".npy"): _read_array(archive, member)
                for member in archive.infolist()
            }
    except (ValueError, OSError):
        raise
    except Exception as error:  # damaged archives raise many types
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from error


def numbers_of(value: Any) -> np.ndarray:
    """Return a number, or nested lists of numbers, of a JSON file as a float64 array.

    Raises:
        ValueError: It holds texts, true, false or null, or lists of different lengths.
    """
    entries = np.array(value, dtype=object)
    if not all(type(entry) in (int, float) for entry in entries.ravel()):
        raise ValueError("it must hold numbers alone")
    return entries.astype(np.float64)


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return one array."""
    with archive.open(member) as stream:
        return parse_array(stream.read(member.file_size + 1), member.filename)


def parse_array(content: bytes, name: str) -> np.ndarray:
    """Return the array of an npy file, after comparing the size in its header with that of its data.

    Raises:
        ValueError: It is no npy file, is damaged, or holds objects; the message names it.
    """
    data = io.BytesIO(content)
    version = format.read_magic(data)
    header = format.read_array_header_1_0 if version == (1, 0) else format.read_array_header_2_0
    shape, is_fortran, dtype = header(data)
    if dtype.hasobject:
        raise ValueError(f"{name} holds Python objects")
    values = data.getvalue()[data.tell() :]
    if math.prod(shape) * dtype.itemsize != len(values):
        raise ValueError(f"{name} announces another size than it has")
    return np.frombuffer(values, dtype).reshape(shape, order="F" if is_fortran else "C").copy()
