"""Limits on MJCF files of others, checked before MuJoCo reads them.

MuJoCo reads whatever files an MJCF names, pipes and devices included, and allocates whatever its attributes
ask for. This module walks the XML of a file and of all that it includes, without compiling it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.parsers import expat

from perception.errors import InvalidInputError
from perception.io.files import check_regular, read_bytes
from sim_assets.errors import RobotFileError

MAX_XML_BYTES = 64 * 2**20
MAX_ASSET_BYTES = 256 * 2**20  # of one mesh, texture or height field
MAX_FILES = 200  # XML files
MAX_DEPTH = 100  # of nested elements
MAX_ELEMENTS = 50_000
MAX_GEOMS = 2_000
# Largest values of attributes that determine how much MuJoCo allocates.
MAX_VALUES = {"width": 8192, "height": 8192, "nrow": 4096, "ncol": 4096}
MAX_USER_VALUES = 1000  # numbers per element that nuser_<element> reserves
_REPEATING = ("replicate", "composite", "flexcomp", "attach")
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def check_mjcf(path: Path) -> None:
    """Check an MJCF file and the files that it names.

    Raises:
        RobotFileError: A file is not regular, too large or not XML, or the model is too large; the message
            names it and the limit.
    """
    try:
        _Walk(path).check()
    except InvalidInputError as error:
        raise RobotFileError(str(error)) from None
    except OSError as error:
        raise RobotFileError(f"{error.filename or path} cannot be read: {error.strerror or error}") from None


class _Walk:
    """Walk through the elements of an MJCF file and of the files that it includes.

    Attributes:
        folder: Folder of the first file, to which names of files are relative.
        seen: Files that were found so far.
        waiting: Those of them that are not walked through yet.
        assets: Names of asset files, with the attributes of ``compiler`` that give their folders.
    """

    def __init__(self, path: Path) -> None:
        self.folder = path.parent
        self.seen, self.waiting = {path}, [path]
        self.assets: set[str] = set()
        self.folders = {self.folder}
        self.elements = self.geoms = 0

    def check(self) -> None:
        while self.waiting:
            self._walk_file(self.waiting.pop())
        for name in sorted(self.assets):
            for folder in self.folders:
                for candidate in (folder / name, folder / Path(name).name):
                    if candidate.exists():
                        check_regular(candidate, MAX_ASSET_BYTES)

    def _walk_file(self, path: Path) -> None:
        content = read_bytes(path, MAX_XML_BYTES)
        parser = expat.ParserCreate()
        repeats = [1]  # of the open elements

        def start(tag: str, attributes: Mapping[str, str]) -> None:
            repeats.append(repeats[-1] * (_count(path, attributes) if tag in _REPEATING else 1))
            if len(repeats) > MAX_DEPTH:
                raise RobotFileError(f"{path}: elements are nested more than {MAX_DEPTH} deep")
            self._count_element(path, tag, repeats[-1])
            _check_values(path, tag, attributes)
            self._collect_files(path, tag, attributes)

        def end(tag: str) -> None:
            repeats.pop()

        def refuse_entity(name: str, *_: object) -> None:
            raise RobotFileError(f"{path} declares the XML entity '{name[:40]}': write it out")

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.EntityDeclHandler = refuse_entity
        try:
            parser.Parse(content, True)
        except expat.ExpatError as error:
            raise RobotFileError(f"{path} cannot be read as MJCF: {error}") from None

    def _count_element(self, path: Path, tag: str, repeats: int) -> None:
        self.elements += repeats
        self.geoms += repeats if tag == "geom" else 0
        if self.geoms > MAX_GEOMS:
            raise RobotFileError(f"{path}: the arm has more than {MAX_GEOMS} geoms: simplify it")
        if self.elements > MAX_ELEMENTS:
            raise RobotFileError(f"{path}: the model has more than {MAX_ELEMENTS} elements: simplify it")

    def _collect_files(self, path: Path, tag: str, attributes: Mapping[str, str]) -> None:
        """Note the files that an element names, and the folders that ``compiler`` gives."""
        if tag == "compiler":
            self.folders |= {self.folder / attributes[key] for key in _FOLDERS if key in attributes}
        for name in _named_files(attributes):
            if tag not in ("include", "model"):
                self.assets.add(name)
                continue
            for candidate in {self.folder / name, path.parent / name} - self.seen:
                if candidate.exists():
                    self.seen.add(candidate)
                    self.waiting.append(candidate)
        if len(self.seen) > MAX_FILES:
            raise RobotFileError(f"{path}: the model has more than {MAX_FILES} XML files")


def _named_files(attributes: Mapping[str, str]) -> Iterator[str]:
    """Yield the values of ``file`` and of a cube texture's ``fileright`` to ``fileback``."""
    for key, value in attributes.items():
        if key.startswith("file") and value and "\0" not in value:
            yield value


def _check_values(path: Path, tag: str, attributes: Mapping[str, str]) -> None:
    """Raise RobotFileError for an attribute that asks for too much memory, or a number that is not finite."""
    for key, text in attributes.items():
        most = MAX_USER_VALUES if key.startswith("nuser_") else MAX_VALUES.get(key)
        if most is not None and not _number(text) <= most:
            raise RobotFileError(f"{path}: {key} = {text[:40]} of <{tag}> must be at most {most}")
        if key in ("pos", "size", "quat") and not all(map(math.isfinite, map(_number, text.split()))):
            raise RobotFileError(f"{path}: {key} = {text[:40]} of <{tag}> must be finite numbers")
        if key.endswith("range"):
            low, high = [_number(word) for word in text.split()] if len(text.split()) == 2 else (0.0, 0.0)
            if not low <= high:  # which MuJoCo reads as no limit at all
                raise RobotFileError(f"{path}: {key} = {text[:40]} of <{tag}> must be two ascending numbers")


def _count(path: Path, attributes: Mapping[str, str]) -> int:
    """Return how often an element repeats its content: the product of its counts."""
    counts = [_number(text) for text in attributes.get("count", "1").split()]
    product = math.prod(counts)
    if not product <= MAX_GEOMS:
        raise RobotFileError(
            f"{path}: count = {attributes['count'][:40]} must be at most {MAX_GEOMS} altogether"
        )
    return max(int(product), 1)


def _number(text: str) -> float:
    """Return an attribute's number; NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
