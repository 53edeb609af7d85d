"""NumPy archives (npz): bounded reading, without pickles."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

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


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """Return one array, after comparing the size in its header with that of its data."""
    with archive.open(member) as stream:
        data = io.BytesIO(stream.read(member.file_size + 1))
    version = format.read_magic(data)
    header = format.read_array_header_1_0 if version == (1, 0) else format.read_array_header_2_0
    shape, is_fortran, dtype = header(data)
    if dtype.hasobject:
        raise ValueError(f"{member.filename} holds Python objects")
    values = data.getvalue()[data.tell() :]
    if math.prod(shape) * dtype.itemsize != len(values):
        raise ValueError(f"{member.filename} announces another size than it has")
    return np.frombuffer(values, dtype).reshape(shape, order="F" if is_fortran else "C").copy()
