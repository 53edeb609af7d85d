"""``nodeslam convert SOURCE``: convert TUM RGB-D and NOCS recordings to scan folders."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.markup import escape

from app.errors import UsageError
from app.options import ConvertOptions
from app.runs.report import Report
from app.runs.run_folder import RunFolder
from app.screen import Screen
from perception.errors import InvalidInputError
from perception.io.recordings.image_pairs import NominalCamera
from perception.io.recordings.nocs import REAL275, is_nocs_recording, open_nocs
from perception.io.recordings.trajectory import Trajectory, read_trajectory
from perception.io.recordings.tum import MAX_TIME_DIFFERENCE, is_tum_recording, open_tum
from perception.io.scan_folder import write_scan
from perception.types import ObjectDetection, RgbdFrame


@dataclass(frozen=True)
class Source:
    """A recording, read one frame at a time.

    Attributes:
        kind: Name of its format.
        count: Number of frames.
        read: Reads the frame of an index.
        detections: Reads the true masks of a frame; None if the format has none.
    """

    kind: str
    count: int
    read: Callable[[int], RgbdFrame]
    detections: Callable[[int], list[ObjectDetection]] | None = None


def run(options: ConvertOptions, screen: Screen) -> Report:
    """Read evenly spaced images of the recording and write them as a scan folder."""
    begin = time.perf_counter()
    source = open_source(options.source, parse_camera(options.camera))
    chosen = np.unique(
        np.linspace(0, source.count - 1, min(options.images, source.count)).round().astype(int)
    )
    frames, detections, warnings = _read(source, [int(index) for index in chosen])
    folder = RunFolder.create(options, "convert")
    with screen.stage(f"Writing {len(frames)} images"):
        write_scan(
            folder.scan, frames, detections if source.detections is not None and any(detections) else None
        )
    for warning in warnings:
        screen.note(f"skipped: {warning}")
    posed = sum(frame.T_world_camera is not None for frame in frames)
    report = Report(
        command="convert",
        seed=options.seed,
        success=True,
        reason=f"{len(frames)} images of {source.count}, {posed} with a camera pose",
        timings={"total": time.perf_counter() - begin},
        metrics={"format": source.kind, "n_images": len(frames), "n_posed": posed, "scan": str(folder.scan)},
        warnings=warnings,
        settings={"source": str(options.source), "images": options.images, "camera": options.camera},
    )
    folder.write_report(report)
    screen.show(escape(f"{report.reason}: {folder.scan}"))
    return report


def open_source(folder: Path, camera: NominalCamera | None) -> Source:
    """Open a recording of any supported format.

    Args:
        folder: Folder of the recording.
        camera: Intrinsics that replace those of the format; None to keep them.

    Raises:
        InvalidInputError: The folder has none of the supported formats.
    """
    if not folder.is_dir():
        raise InvalidInputError(f"{folder} is no folder: give a recording's folder")
    if is_tum_recording(folder):
        tum = open_tum(folder)
        tum = replace(tum, camera=camera) if camera else tum
        truth = folder / "groundtruth.txt"
        trajectory = read_trajectory(truth) if truth.is_file() else None
        return Source("TUM RGB-D", len(tum.pairs), lambda index: _posed(tum.read(index), trajectory))
    if is_nocs_recording(folder):
        nocs = open_nocs(folder, camera or REAL275)
        return Source("NOCS", len(nocs.numbers), nocs.read, nocs.detections)
    raise InvalidInputError(
        f"{folder} holds neither rgb.txt and depth.txt (TUM RGB-D) nor <number>_color.png, _depth.png (NOCS)"
    )


def parse_camera(text: str | None) -> NominalCamera | None:
    """Parse focal lengths and principal point from ``fx,fy,cx,cy``.

    Raises:
        UsageError: The text is not four positive numbers.
    """
    if text is None:
        return None
    try:
        fx, fy, cx, cy = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--camera takes fx,fy,cx,cy in pixels of a 640 px wide image, not '{text}'"
        ) from None
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, cx, cy) > 0):
        raise UsageError(f"--camera {text}: the four numbers must be positive")
    return NominalCamera(fx, fy, cx, cy)


def _posed(frame: RgbdFrame, trajectory: Trajectory | None) -> RgbdFrame:
    """Return the frame with the pose nearest in time; unchanged without a trajectory.

    Raises:
        InvalidInputError: The nearest pose is more than MAX_TIME_DIFFERENCE away.
    """
    if trajectory is None:
        return frame
    apart = np.abs(trajectory.times - frame.time)
    nearest = int(apart.argmin()) if len(apart) else -1
    if nearest < 0 or apart[nearest] > MAX_TIME_DIFFERENCE:
        raise InvalidInputError(
            f"the image at {frame.time:.3f} s has no pose in groundtruth.txt near it in time"
        )
    return replace(frame, T_world_camera=trajectory.Ts_world_camera[nearest])


def _read(
    source: Source, chosen: Sequence[int]
) -> tuple[list[RgbdFrame], list[list[ObjectDetection]], list[str]]:
    """Return the chosen frames, their detections, and a warning for each unusable frame.

    Raises:
        InvalidInputError: No frame is usable.
    """
    frames: list[RgbdFrame] = []
    detections: list[list[ObjectDetection]] = []
    warnings: list[str] = []
    for index in chosen:
        try:
            frame = source.read(index)
            found = source.detections(index) if source.detections is not None else []
        except InvalidInputError as error:
            warnings.append(str(error))
            continue
        frames.append(frame)
        detections.append(found)
    if not frames:
        raise InvalidInputError(warnings[0])
    return frames, detections, warnings
