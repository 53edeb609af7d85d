"""Ground truth of a sequence, for scoring and pictures only."""

from __future__ import annotations

from pathlib import Path

from perception.io.files import read_json
from perception.io.object_map import read_ply
from perception.io.recordings.trajectory import Trajectory, read_trajectory
from perception.types import TriangleMesh

TRUTH = "ground_truth"  # folder inside that of the sequence


def read_true_trajectory(folder: Path) -> Trajectory | None:
    """Return the true trajectory of a sequence, None if it has none."""
    path = folder / TRUTH / "trajectory.txt"
    if path.is_file():
        return read_trajectory(path)
    path = folder / "groundtruth.txt"  # TUM RGB-D
    return read_trajectory(path) if path.is_file() else None


def read_true_objects(folder: Path) -> list[tuple[str, TriangleMesh]]:
    """Return class and surface in the world frame of every true object."""
    entries = read_json(folder / TRUTH / "objects.json", "give a sequence that was generated here")
    return [(entry["category"], read_ply(folder / TRUTH / entry["mesh"])) for entry in entries]
