"""Synthetic sequences on disk: a scan folder with the first pose only, and the ground truth in a folder.

rgb/, depth/, scene_camera.json   recorded data; only the first image has a pose
ground_truth/trajectory.txt       true camera poses (TUM), for scoring only
ground_truth/objects/<i>_<class>.ply, objects.json   true surfaces in the world frame, and their poses
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from app.slam.sequence_truth import TRUTH
from perception.io.files import write_atomically, write_json
from perception.io.object_map import ply_bytes
from perception.io.recordings.trajectory import Trajectory, write_trajectory
from perception.io.scan_folder import ScanWriter
from perception.types import TriangleMesh
from sim_assets.datasets.sequences import TableSequence


def write_sequence(
    folder: Path, sequence: TableSequence, progress: Callable[[int, int], None] = lambda done, total: None
) -> None:
    """Render and write a sequence; ``scene_camera.json`` is written last and marks a complete folder."""
    _write_truth(folder / TRUTH, sequence)
    writer = ScanWriter(folder)
    for index, image in enumerate(sequence.render()):
        frame = image.frame if index == 0 else replace(image.frame, T_world_camera=None)
        writer.add(frame)
        progress(index + 1, sequence.config.frames)
    writer.close()


def is_complete(folder: Path) -> bool:
    """Return whether a folder holds a complete sequence."""
    return (folder / "scene_camera.json").is_file()


def _write_truth(folder: Path, sequence: TableSequence) -> None:
    entries = []
    for index, item in enumerate(sequence.objects):
        mesh = TriangleMesh(np.asarray(item.model.mesh.vertices), np.asarray(item.model.mesh.faces))
        name = f"{index}_{item.model.category}.ply"
        write_atomically(folder / "objects" / name, ply_bytes(mesh.transformed(item.T_world_object)))
        entries.append(
            {
                "id": index,
                "category": item.model.category,
                "mesh": f"objects/{name}",
                "T_world_object": item.T_world_object.tolist(),
            }
        )
    write_json(folder / "objects.json", entries)
    times = [index / sequence.rate for index in range(len(sequence.Ts_world_camera))]
    write_trajectory(folder / "trajectory.txt", Trajectory.of(times, list(sequence.Ts_world_camera)))
