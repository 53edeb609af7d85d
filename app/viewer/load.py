"""A run folder, or a folder with an object map, as a recording; needs no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from app.errors import UsageError
from app.runs.replay import Recorder, read_recording
from perception.io.files import read_json
from perception.io.object_map import read_object_map
from perception.io.scan_folder import Scan, read_scan


@dataclass(frozen=True)
class Run:
    """A recording and the report that goes with it; the report is empty where there is none."""

    recorder: Recorder
    report: dict[str, Any]


def load_run(folder: Path) -> Run:
    """Read everything a folder has to show.

    Raises:
        UsageError: there is nothing to show.
        InvalidInputError: a file is malformed; the message names it.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder: give a run folder, or one with an object map")
    recorder = read_recording(folder) if (folder / "replay.json").is_file() else Recorder()
    scan = _scan(folder)
    if scan is not None:
        recorder.frames = list(scan.frames)
        recorder.detections = scan.detections or ()
    if (folder / "objects.json").is_file():
        recorder.objects = tuple(read_object_map(folder))
    if not (recorder.notes or recorder.frames or recorder.objects):
        raise UsageError(f"{folder} holds no replay.json, objects.json or images: nothing to show")
    if not recorder.notes:
        _tell(recorder)
    report = read_json(folder / "report.json", "") if (folder / "report.json").is_file() else {}
    return Run(recorder, report if isinstance(report, dict) else {})


def _scan(folder: Path) -> Scan | None:
    """The images of a run folder, of a scan folder, or none."""
    for place in (folder / "scan", folder):
        if (place / "scene_camera.json").is_file():
            return read_scan(place)
    return None


def _tell(recorder: Recorder) -> None:
    """Notes for what was not recorded as it happened: images, detections and objects one after another."""
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
