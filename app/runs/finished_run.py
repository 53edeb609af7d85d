"""Reading a finished run: its object map and the images it was made from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.errors import UsageError
from perception.errors import InvalidInputError, PerceptionError
from perception.io.files import read_json
from perception.io.object_map import read_object_map
from perception.io.recordings.sequence import open_sequence
from perception.io.recordings.trajectory import read_trajectory
from perception.io.scan_folder import Scan, read_scan
from perception.support_plane import fit_support_plane
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

MIN_EXTENT, MAX_EXTENT, MIN_VOLUME = 1e-3, 10.0, 1e-9  # of an object's mesh [m], [m], [m³]
SAME_TIME = 1e-4  # [s]: trajectories are written to the microsecond


@dataclass(frozen=True)
class FinishedRun:
    """Object map of a run folder with its support plane and images.

    Attributes:
        path: Folder.
        objects: Object map, with at least one object.
        plane: Support plane of the objects in the world frame.
        frames: Recorded images with their camera poses; empty if there are none.
    """

    path: Path
    objects: tuple[ObjectEstimate, ...]
    plane: SupportPlane
    frames: tuple[RgbdFrame, ...]


def read_run(path: Path) -> FinishedRun:
    """Read a run folder of pack, sort, reconstruct or slam, or a scan folder with an ``objects.json``.

    Raises:
        UsageError: The path is no folder, or its object map is empty.
        InvalidInputError: The object map is missing or malformed, or a mesh encloses no volume.
    """
    if not path.is_dir():
        raise UsageError(f"{path} is not a folder: give the run folder that pack, sort or reconstruct wrote")
    objects = read_object_map(path)
    if not objects:
        raise UsageError(f"{path}/objects.json holds no object: scan and reconstruct again")
    for estimate in objects:
        _require_volume(path, estimate)
    folder = next((p for p in (path / "scan", path) if (p / "scene_camera.json").is_file()), None)
    frames = posed_frames(read_scan(folder)) if folder else ()
    return FinishedRun(path, tuple(objects), support_of(objects, frames), frames)


def _require_volume(path: Path, estimate: ObjectEstimate) -> None:
    """Raise InvalidInputError for a mesh that no rigid body can have."""
    a, b, c = np.moveaxis(estimate.mesh.vertices[estimate.mesh.faces], 1, 0)
    volume = float(np.einsum("fi,fi->", a, np.cross(b, c))) / 6
    extents = np.ptp(estimate.mesh.vertices, axis=0)
    if extents.min() < MIN_EXTENT or extents.max() > MAX_EXTENT or volume < MIN_VOLUME:
        size = " x ".join(f"{extent:.3g}" for extent in extents)
        raise InvalidInputError(
            f"{path}/objects: the mesh of {estimate.name} ({size} m, volume {volume:.2g} m³) is no "
            "solid object: reconstruct the scan again"
        )


def posed_frames(scan: Scan) -> tuple[RgbdFrame, ...]:
    """Return the images with a known camera pose; if there are none, the first one, as the world frame."""
    posed = tuple(frame for frame in scan.frames if frame.T_world_camera is not None)
    return posed or (replace(scan.frames[0], T_world_camera=np.eye(4)),)


def tracked_frames(path: Path, seconds: float) -> tuple[RgbdFrame, ...]:
    """Return the images of the first ``seconds`` of a SLAM run with their estimated camera poses.

    The result is empty for a run of another command, or if the sequence cannot be found any more.

    Raises:
        InvalidInputError: ``trajectory.txt`` or ``report.json`` is malformed.
    """
    try:
        sequence = next(map(open_sequence, recorded_sequence(path)), None)
    except InvalidInputError:
        return ()
    if sequence is None:
        return ()
    trajectory = read_trajectory(path / "trajectory.txt")
    frames: list[RgbdFrame] = []
    for _, frame in sequence.frames():
        if isinstance(frame, InvalidInputError) or not len(trajectory.times):
            continue
        if frame.time > trajectory.times[0] + seconds:
            break
        nearest = int(np.abs(trajectory.times - frame.time).argmin())
        if abs(trajectory.times[nearest] - frame.time) < SAME_TIME:
            frames.append(replace(frame, T_world_camera=trajectory.Ts_world_camera[nearest]))
    return tuple(frames)


def recorded_sequence(path: Path) -> tuple[Path, ...]:
    """Return the folder of the sequence of a SLAM run; empty for a run of another command.

    Raises:
        InvalidInputError: ``report.json`` is malformed.
    """
    if not (path / "trajectory.txt").is_file() or not (path / "report.json").is_file():
        return ()
    report = read_json(path / "report.json", "run slam again")
    settings = report.get("settings") if isinstance(report, dict) else None
    sequence = settings.get("sequence") if isinstance(settings, dict) else None
    return (Path(sequence),) if isinstance(sequence, str) and sequence else ()


def support_of(objects: Sequence[ObjectEstimate], frames: Sequence[RgbdFrame]) -> SupportPlane:
    """Fit the support plane to the images; without images, to the bases of the objects."""
    if frames:
        try:
            return fit_support_plane(frames)
        except PerceptionError:
            pass  # too little of the plane is visible: use the objects
    up = np.mean([estimate.T_world_object[:3, 2] for estimate in objects], axis=0)
    up /= np.linalg.norm(up)
    bases = [float((estimate.mesh_world.vertices @ up).min()) for estimate in objects]
    return SupportPlane(up, float(np.median(bases)))
