"""Arrays that several processes read from one copy: files that are mapped into memory."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

Arrays = TypeVar("Arrays")
FOLDER = "mapped"


@dataclass(frozen=True)
class Mapped(Generic[Arrays]):
    """A dataclass of arrays, stored in one file for each.

    Attributes:
        kind: The dataclass; all its fields are arrays.
        files: File of each field.
    """

    kind: type[Arrays]
    files: dict[str, Path]

    @staticmethod
    def write(arrays: Any, folder: Path) -> Mapped[Any]:
        """Write the arrays into a new folder."""
        folder.mkdir(parents=True)
        files = {field.name: folder / f"{field.name}.npy" for field in fields(arrays)}
        for name, file in files.items():
            np.save(file, getattr(arrays, name))
        return Mapped(type(arrays), files)

    def open(self) -> Arrays:
        """Return the dataclass; processes share the memory of what they do not change."""
        return self.kind(**{name: _mapped(file) for name, file in self.files.items()})


@contextmanager
def folder_of_arrays(out_dir: Path) -> Iterator[Path]:
    """Yield a folder for arrays that is removed afterwards, as the one of a killed process is at first."""
    folder = out_dir / FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _mapped(file: Path) -> np.ndarray:
    array = np.load(file, mmap_mode="c") if _has_content(file) else np.load(file)
    return np.asarray(array)


def _has_content(file: Path) -> bool:
    """Return whether a file has more than its header: nothing cannot be mapped."""
    with file.open("rb") as stream:
        version = np.lib.format.read_magic(stream)
        assert version == (1, 0)
        shape, _, _ = np.lib.format.read_array_header_1_0(stream)
    return 0 not in shape
