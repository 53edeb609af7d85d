"""A run folder, or a folder with an object map or a scan, as a recording; needs no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app.errors import UsageError
from app.runs.note_schema import is_finite_number
from app.runs.replay import Recorder, read_recording
from app.viewer.snapshot import ObjectOutcome
from perception.errors import InvalidInputError
from perception.io.files import read_json
from perception.io.object_map import read_object_map
from perception.io.scan_folder import Scan, read_scan

MAX_NORM_ERROR = 1e-3  # of quaternions in single precision


@dataclass(frozen=True)
class RunSummary:
    """The part of a report that the viewer shows.

    Attributes:
        command: Command of the run; empty without a report.
        seed: Its seed, or None.
        reason: Its result in one line.
        outcomes: Outcomes of the objects by id.
    """

    command: str = ""
    seed: int | None = None
    reason: str = ""
    outcomes: Mapping[int, ObjectOutcome] = field(default_factory=dict)


@dataclass(frozen=True)
class LoadedRun:
    """A recording, and the summary of its report."""

    recorder: Recorder
    summary: RunSummary = field(default_factory=RunSummary)


def load_run(folder: Path) -> LoadedRun:
    """Read and validate all files of a folder that the viewer shows.

    Raises:
        UsageError: The folder does not exist, or contains nothing to show.
        InvalidInputError: A file is malformed; the message names it.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder: give a run folder, or one with an object map or a scan")
    recorder = read_recording(folder) if (folder / "replay.json").is_file() else Recorder()
    _check_orientations(folder, recorder)
    scan = _read_scan(folder)
    if scan is not None:
        recorder.frames = list(scan.frames)
        recorder.detections = scan.detections or ()
    if (folder / "objects.json").is_file():
        recorder.objects = tuple(read_object_map(folder))
    if not (recorder.notes or recorder.frames or recorder.objects):
        raise UsageError(f"{folder} contains no replay.json, objects.json or images: nothing to show")
    if not recorder.notes:
        _add_notes(recorder)
    return LoadedRun(recorder, read_summary(folder / "report.json"))


def read_summary(path: Path) -> RunSummary:
    """Read the summary of a report; empty if the file does not exist.

    Raises:
        InvalidInputError: The file is malformed; the message names it and the field.
    """
    remedy = "run it again, or remove the file"
    if not path.is_file():
        return RunSummary()
    report = read_json(path, remedy)
    try:
        if not isinstance(report, dict):
            raise ValueError("it must be an object")
        command, reason = (_typed(report, key, str, "text") or "" for key in ("command", "reason"))
        _typed(report, "success", bool, "true or false")
        seed = _typed(report, "seed", int, "an integer")
        objects = _typed(report, "objects", list, "a list") or []
        outcomes = dict(_outcome(index, entry) for index, entry in enumerate(objects))
    except ValueError as error:
        raise InvalidInputError(f"{path}: {error}: {remedy}") from None
    return RunSummary(command, seed, reason, outcomes)


def _typed(entry: Mapping[str, Any], key: str, kind: type, description: str) -> Any:
    """Return the value of a key, which may be missing or null."""
    value = entry.get(key)
    if value is not None and (not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool)):
        raise ValueError(f"{key} must be {description}")
    return value


def _outcome(index: int, entry: Any) -> tuple[int, ObjectOutcome]:
    """Return id and outcome of an entry of the report."""
    try:
        if not isinstance(entry, dict):
            raise ValueError("it must be an object")
        id = _typed(entry, "id", int, "an integer")
        if id is None:
            raise ValueError("id is missing")
        placed = bool(_typed(entry, "placed", bool, "true, false or null"))
        error = entry.get("error_position")
        if error is not None and not is_finite_number(error):
            raise ValueError("error_position must be a finite number or null")
    except ValueError as problem:
        raise ValueError(f"object {index}: {problem}") from None
    return id, ObjectOutcome(placed, error)


def _check_orientations(folder: Path, recorder: Recorder) -> None:
    """Check that the quaternions of the bodies are of length 1."""
    for sample, poses in enumerate(recorder.poses):
        wrong = np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1) > MAX_NORM_ERROR
        if wrong.any():
            body = recorder.bodies[int(wrong.argmax())]
            raise InvalidInputError(
                f"{folder}/replay.npz, sample {sample}: the quaternion of {body} is not of length 1: "
                "run it again"
            )


def _read_scan(folder: Path) -> Scan | None:
    """Return the images of a run folder or a scan folder; None if there are none."""
    for path in (folder / "scan", folder):
        if (path / "scene_camera.json").is_file():
            return read_scan(path)
    return None


def _add_notes(recorder: Recorder) -> None:
    """Add notes to results without a recording: images, detections and objects one after another."""
    if recorder.frames:
        recorder.note("stage", name="scan")
        for index in range(len(recorder.frames)):
            recorder.note("look", index=index)
    if recorder.detections:
        recorder.note("stage", name="detect")
        for index, found in enumerate(recorder.detections):
            recorder.note("found", index=index, count=len(found))
    if recorder.objects:
        recorder.note("stage", name="reconstruct")
        recorder.note("objects", covariances={})
