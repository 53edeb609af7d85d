"""``nodeslam convert SOURCE``: convert recordings of colour and depth images to scan folders."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
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
from perception.io.detections import write_detections
from perception.io.recordings.camera_files import ORIGINAL_WIDTH, find_camera
from perception.io.recordings.image_pairs import NominalCamera
from perception.io.recordings.nocs import REAL275, is_nocs_recording, open_nocs
from perception.io.recordings.numbered import is_numbered_recording, open_numbered
from perception.io.recordings.trajectory import Trajectory, read_trajectory
from perception.io.recordings.tum import MAX_TIME_DIFFERENCE, is_tum_recording, open_tum
from perception.io.scan_cameras import check_camera
from perception.io.scan_folder import ScanWriter
from perception.types import ObjectDetection, RgbdFrame

PLAUSIBLE_DEPTH = (0.15, 8.0)  # [m] median of a recording; outside it, the unit is probably wrong
FORMATS = (
    "rgb.txt and depth.txt (TUM RGB-D); <number>_color.png and _depth.png (NOCS); frame-<number>.color.png "
    "and .depth.png (7-Scenes); folders rgb/ or color/ and depth/ with images of the same number"
)


@dataclass(frozen=True)
class Source:
    """A recording, read one frame at a time.

    Attributes:
        kind: Name of its format.
        count: Number of frames.
        read: Reads the frame of an index.
        detections: Reads the true masks of a frame; None if the format has none.
        warnings: Problems of the recording as a whole.
    """

    kind: str
    count: int
    read: Callable[[int], RgbdFrame]
    detections: Callable[[int], list[ObjectDetection]] | None = None
    warnings: tuple[str, ...] = ()


def run(options: ConvertOptions, screen: Screen) -> Report:
    """Read evenly spaced images of the recording and write them as a scan folder, one at a time."""
    begin = time.perf_counter()
    source = open_source(options.source, parse_camera(options.camera), parse_depth_scale(options.depth_scale))
    chosen = np.unique(
        np.linspace(0, source.count - 1, min(options.images, source.count)).round().astype(int)
    )
    skipped: list[str] = []
    usable = _usable(source, [int(index) for index in chosen], skipped)
    first = next(usable, None)
    if first is None:
        raise InvalidInputError(skipped[0])
    folder = RunFolder.create(options, "convert")
    with screen.stage(f"Writing {len(chosen)} images"):
        written = _write(folder.scan, itertools.chain([first], usable), screen, len(chosen))
    depth, implausible = _median_depth(written.median_depths)
    warnings = [*source.warnings, *(f"skipped: {problem}" for problem in skipped), *implausible]
    for warning in warnings:
        screen.note(warning)
    report = Report(
        command="convert",
        seed=options.seed,
        success=True,
        reason=(
            f"{written.n_images} images of {source.count}, {written.n_posed} with a camera pose, "
            f"median depth {depth:.2f} m"
        ),
        timings={"total": time.perf_counter() - begin},
        metrics={
            "format": source.kind,
            "n_images": written.n_images,
            "n_posed": written.n_posed,
            "median_depth": depth,
            "scan": str(folder.scan),
        },
        warnings=warnings,
        settings={
            "source": str(options.source),
            "images": options.images,
            "camera": options.camera,
            "depth_scale": options.depth_scale,
        },
    )
    folder.write_report(report)
    screen.show(escape(f"{report.reason}: {folder.scan}"))
    return report


def open_source(folder: Path, camera: NominalCamera | None, units_per_metre: float | None = None) -> Source:
    """Open a recording of any supported format.

    Args:
        folder: Folder of the recording.
        camera: Intrinsics that replace those of the format; None to keep them.
        units_per_metre: Unit of the depth images that replaces that of the format; None to keep it.

    Raises:
        InvalidInputError: The folder has none of the supported formats.
    """
    if not folder.is_dir():
        raise InvalidInputError(f"{folder} is no folder: give a recording's folder")
    if (folder / "scene_camera.json").is_file():
        raise InvalidInputError(f"{folder} is a scan folder already: reconstruct and slam read it as it is")
    unit = {"units_per_metre": units_per_metre} if units_per_metre else {}
    stated = camera or find_camera(folder)
    if is_tum_recording(folder):
        tum = replace(open_tum(folder), **unit)
        tum = replace(tum, camera=camera) if camera else tum
        truth = folder / "groundtruth.txt"
        trajectory = read_trajectory(truth) if truth.is_file() else None
        missing = f"{tum.n_missing} listed image pairs have no files" if tum.n_missing else ""
        return Source(
            "TUM RGB-D",
            len(tum.pairs),
            lambda index: _posed(tum.read(index), trajectory),
            warnings=(missing,) if missing else (),
        )
    if is_nocs_recording(folder):
        nocs = replace(open_nocs(folder, stated or REAL275), **unit)
        return Source("NOCS", len(nocs.numbers), nocs.read, nocs.detections)
    if is_numbered_recording(folder):
        numbered = open_numbered(folder, stated, **unit)
        return Source("numbered images", len(numbered.pairs), numbered.read)
    raise InvalidInputError(f"{folder} holds no recording that is known: {FORMATS}")


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
        raise UsageError(f"--camera takes fx,fy,cx,cy in pixels, not '{text}'") from None
    if not (np.isfinite([fx, fy, cx, cy]).all() and min(fx, fy, cx, cy) > 0):
        raise UsageError(f"--camera {text}: the four numbers must be positive")
    return NominalCamera(fx, fy, cx, cy, ORIGINAL_WIDTH)


def parse_depth_scale(scale: float | None) -> float | None:
    """Return the units per metre of depth images of ``scale`` millimetres per unit.

    Raises:
        UsageError: The scale is not a number in 0.001..100.
    """
    if scale is None:
        return None
    if not 1e-3 <= scale <= 100:
        raise UsageError(f"--depth-scale {scale:g} must be in 0.001..100 millimetres per unit")
    return 1000 / scale


def _median_depth(medians: Sequence[float]) -> tuple[float, list[str]]:
    """Return the median of the images' median depths in metres, and a warning if it is implausible."""
    depth = float(np.median(medians)) if medians else 0.0
    if PLAUSIBLE_DEPTH[0] <= depth <= PLAUSIBLE_DEPTH[1]:
        return depth, []
    return depth, [f"the median depth is {depth:.3g} m: check --depth-scale, the millimetres per unit"]


def _posed(frame: RgbdFrame, trajectory: Trajectory | None) -> RgbdFrame:
    """Return the frame with the pose nearest in time; unchanged without a trajectory.

    Raises:
        InvalidInputError: The nearest pose is more than MAX_TIME_DIFFERENCE away.
    """
    if trajectory is None:
        return frame
    pose = trajectory.nearest(frame.time, MAX_TIME_DIFFERENCE)
    if pose is None:
        raise InvalidInputError(
            f"the image at {frame.time:.3f} s has no pose in groundtruth.txt near it in time"
        )
    return replace(frame, T_world_camera=pose)


def _usable(
    source: Source, chosen: Sequence[int], skipped: list[str]
) -> Iterator[tuple[RgbdFrame, list[ObjectDetection] | None]]:
    """Yield the chosen frames with their detections; append the problems of unusable ones to ``skipped``."""
    for index in chosen:
        try:
            frame = source.read(index)
            _check_camera(frame)
            yield frame, source.detections(index) if source.detections is not None else None
        except InvalidInputError as error:
            skipped.append(str(error))


def _check_camera(frame: RgbdFrame) -> None:
    try:
        check_camera(frame)
    except InvalidInputError as error:
        raise InvalidInputError(f"the image at {frame.time:.3f} s: {error}") from None


@dataclass(frozen=True)
class _Written:
    """What was written: numbers of images and poses, and the median depth of each image with measurements."""

    n_images: int
    n_posed: int
    median_depths: tuple[float, ...]


def _write(
    folder: Path, frames: Iterable[tuple[RgbdFrame, list[ObjectDetection] | None]], screen: Screen, total: int
) -> _Written:
    """Write the frames as a scan folder while they are read: long recordings do not fit into memory."""
    writer = ScanWriter(folder)
    detections: list[list[ObjectDetection]] = []
    depths, n_posed, n_images = [], 0, 0
    for frame, found in frames:
        writer.add(frame)
        detections.append(found or [])
        measured = frame.depth[frame.depth > 0]
        depths += [float(np.median(measured))] if measured.size else []
        n_posed += frame.T_world_camera is not None
        n_images += 1
        screen.update(f"{n_images} of {total}")
    if any(detections):
        write_detections(folder, detections)
    writer.close()
    return _Written(n_images, n_posed, tuple(depths))
