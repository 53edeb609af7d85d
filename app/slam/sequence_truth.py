"""Ground truth of a sequence, for scoring and pictures only."""

from __future__ import annotations

from pathlib import Path

import msgspec

from perception.errors import InvalidInputError
from perception.io.files import read_json
from perception.io.object_map import read_ply
from perception.io.recordings.trajectory import Trajectory, read_trajectory
from perception.types import Category, TriangleMesh

_REMEDY = "give a sequence that was generated here"
TRUTH = "ground_truth"  # folder inside that of the sequence


class _TrueObject(msgspec.Struct):
    category: Category
    mesh: str


def read_true_trajectory(folder: Path) -> Trajectory | None:
    """Return the true trajectory of a sequence, None if it has none."""
    path = folder / TRUTH / "trajectory.txt"
    if path.is_file():
        return read_trajectory(path)
    path = folder / "groundtruth.txt"  # TUM RGB-D
    return read_trajectory(path) if path.is_file() else None


def read_true_objects(folder: Path) -> list[tuple[str, TriangleMesh]]:
    """Return class and surface in the world frame of every true object.

    Raises:
        InvalidInputError: A file is missing or malformed; the message names it.
    """
    truth = folder / TRUTH
    path = truth / "objects.json"
    try:
        entries = msgspec.convert(read_json(path, _REMEDY), list[_TrueObject])
    except msgspec.ValidationError as error:
        raise InvalidInputError(f"{path}: {error}: {_REMEDY}") from None
    for entry in entries:
        if not (truth / entry.mesh).resolve().is_relative_to(truth.resolve()):
            raise InvalidInputError(f"{path}: {entry.mesh[:80]!r} leads out of the folder: {_REMEDY}")
    return [(entry.category, read_ply(truth / entry.mesh)) for entry in entries]
