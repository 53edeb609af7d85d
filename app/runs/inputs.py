"""Files and folders that a command reads, so that no run folder is written over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from app.errors import UsageError
from app.options import CommonOptions

_OUTPUTS = ("out", "html")  # options of type Path that a command writes to
_NAMES_OR_PATHS = ("robot", "detector")  # options of type str that take a name or a path


def inputs_of(options: CommonOptions) -> list[Path]:
    """Return the paths that the options name as inputs: each option that holds a path and is no output."""
    values = {field.name: getattr(options, field.name) for field in fields(options)}
    paths = [value for name, value in values.items() if isinstance(value, Path) and name not in _OUTPUTS]
    for name in _NAMES_OR_PATHS:
        value = values.get(name)
        if value and _exists(Path(value)):
            paths.append(Path(value))
    return paths


def require_disjoint(out: Path, inputs: Sequence[Path]) -> None:
    """Require that an output folder neither is, nor contains, nor lies inside an input, all links resolved.

    Raises:
        UsageError: It does; the message names the input.
    """
    target = out.resolve()
    for path in inputs:
        source = path.resolve()
        if target == source:
            relation = "is the input itself"
        elif target in source.parents:
            relation = f"contains the input {path}"
        elif source in target.parents:
            relation = f"lies inside the input {path}"
        else:
            continue
        raise UsageError(f"--out {out} {relation}: give another folder")


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name that no file can have
        return False
