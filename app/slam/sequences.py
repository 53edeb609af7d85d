"""Synthetic sequences on disk: a scan folder with the first pose alone, and the truth in a folder of its own.

rgb/, depth/, scene_camera.json   what a camera would record; the first image has its pose
ground_truth/trajectory.txt       true camera poses (TUM), for scoring alone
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
    """Render a sequence and write it; ``scene_camera.json`` comes last: a folder that has one is complete."""
    _write_truth(folder / TRUTH, sequence)
    writer = ScanWriter(folder)
    for index, image in enumerate(sequence.render()):
        frame = image.frame if index == 0 else replace(image.frame, T_world_camera=None)
        writer.add(frame)
        progress(index + 1, sequence.config.frames)
    writer.close()


def is_complete(folder: Path) -> bool:
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
