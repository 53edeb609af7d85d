"""What a finished run left behind, read back: the object map, and the images it was made from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.errors import UsageError
from perception.errors import PerceptionError
from perception.object_map import read_object_map
from perception.scan_folder import Scan, read_scan
from perception.support_plane import fit_support_plane
from perception.types import ObjectEstimate, SupportPlane


@dataclass(frozen=True)
class FinishedRun:
    """A run folder's object map with its support.

    Attributes:
        path: the folder.
        objects: the object map, at least one object.
        plane: what the objects stand on, in the world frame.
        scan: the recorded images with their poses; None where there are none.
    """

    path: Path
    objects: tuple[ObjectEstimate, ...]
    plane: SupportPlane
    scan: Scan | None


def read_run(path: Path) -> FinishedRun:
    """The folder that pack, sort, reconstruct or slam wrote, or a scan folder with an ``objects.json``.

    Raises:
        UsageError: no folder, or its object map is empty.
        InvalidInputError: its object map is missing or malformed.
    """
    if not path.is_dir():
        raise UsageError(f"{path} is not a folder: give the run folder that pack, sort or reconstruct wrote")
    objects = read_object_map(path)
    if not objects:
        raise UsageError(f"{path}/objects.json holds no object: scan and reconstruct again")
    scan = next((read_scan(p) for p in (path / "scan", path) if (p / "scene_camera.json").is_file()), None)
    return FinishedRun(path, tuple(objects), support_of(objects, scan), scan)


def support_of(objects: list[ObjectEstimate], scan: Scan | None) -> SupportPlane:
    """The plane in the images where there are some, else the one under the objects."""
    posed = tuple(frame for frame in scan.frames if frame.T_world_camera is not None) if scan else ()
    if posed:
        try:
            return fit_support_plane(posed)
        except PerceptionError:
            pass  # mostly objects in view: they say it as well
    up = np.mean([estimate.T_world_object[:3, 2] for estimate in objects], axis=0)
    up /= np.linalg.norm(up)
    bases = [float((estimate.mesh_world.vertices @ up).min()) for estimate in objects]
    return SupportPlane(up, float(np.median(bases)))
