"""TUM RGB-D recordings: ``rgb.txt`` and ``depth.txt`` list images with their times, depth in 1/5000 m.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Colour and depth are registered, but taken at
different times: each depth image goes with the colour image nearest to it. The folder's name tells the camera
(freiburg1, 2, 3); a file ``intrinsics.txt`` with ``fx fy cx cy`` overrides that.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from perception.errors import InvalidInputError
from perception.io.scan_folder import read_png
from perception.types import CameraIntrinsics, RgbdFrame

DEPTH_UNITS = 5000.0  # per metre
MAX_APART = 0.02  # [s] between a depth image and its colour image

# Focal lengths and principal points [px] of the calibrated cameras, from the dataset's page.
CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
}
DEFAULT_CAMERA = (525.0, 525.0, 319.5, 239.5)  # what the dataset recommends otherwise


@dataclass(frozen=True)
class TumRecording:
    """A recording's folder, its images in pairs (time [s], colour, depth), and its camera at 640 x 480."""

    folder: Path
    pairs: tuple[tuple[float, str, str], ...]
    camera: tuple[float, float, float, float]

    def read(self, number: int) -> RgbdFrame:
        """One frame; InvalidInputError names the image that cannot be used."""
        time, colour, depth = self.pairs[number]
        rgb: UInt8[np.ndarray, "_h _w 3"] = read_png(self.folder, colour, ("RGB",), "8-bit RGB")
        raw: UInt16[np.ndarray, "_h _w"] = read_png(self.folder, depth, ("I;16", "I;16B", "I"), "16-bit grey")
        if raw.shape != rgb.shape[:2]:
            raise InvalidInputError(f"{self.folder / depth} and {colour} differ in size: register them")
        height, width = raw.shape
        fx, fy, cx, cy = np.array(self.camera) * (width / 640.0)
        intrinsics = CameraIntrinsics(width, height, float(fx), float(fy), float(cx), float(cy))
        return RgbdFrame(time, rgb, (raw / DEPTH_UNITS).astype(np.float32), intrinsics)


def is_tum_recording(folder: Path) -> bool:
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def open_tum(folder: Path) -> TumRecording:
    """Reads the lists and pairs the images.

    Raises:
        InvalidInputError: a list is malformed, or no depth image has a colour image near it in time.
    """
    colours, depths = (_read_list(folder / name) for name in ("rgb.txt", "depth.txt"))
    times = np.array([time for time, _ in colours])
    pairs, used = [], set()
    for time, depth in depths:
        nearest = int(np.abs(times - time).argmin())
        if abs(times[nearest] - time) <= MAX_APART and nearest not in used:
            used.add(nearest)
            pairs.append((time, colours[nearest][1], depth))
    if not pairs:
        raise InvalidInputError(
            f"{folder}: no depth image has a colour image within {1000 * MAX_APART:.0f} ms; check the lists"
        )
    return TumRecording(folder, tuple(pairs), _camera(folder))


def _camera(folder: Path) -> tuple[float, float, float, float]:
    path = folder / "intrinsics.txt"
    if path.is_file():
        try:
            fx, fy, cx, cy = (float(word) for word in path.read_text().split())
        except ValueError:
            raise InvalidInputError(f"{path} must hold four numbers: fx fy cx cy [px at 640x480]") from None
        return fx, fy, cx, cy
    return next((camera for name, camera in CAMERAS.items() if name in folder.name), DEFAULT_CAMERA)


def _read_list(path: Path) -> list[tuple[float, str]]:
    entries = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            entries.append((float(words[0]), words[1]))
        except (ValueError, IndexError):
            raise InvalidInputError(f"{path}, line {number}: expected a time and a file name") from None
    if not entries:
        raise InvalidInputError(f"{path} lists no image")
    return sorted(entries)
