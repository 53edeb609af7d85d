"""Frames as NOCS keeps them (REAL275, CAMERA25): ``0000_color.png``, ``0000_depth.png``, mask and meta file.

Depth is 16-bit in millimetres. ``0000_mask.png`` holds an instance number in each pixel, 255 outside; a
line of ``0000_meta.txt`` tells an instance's class: ``<instance> <class> <model>``. Poses are not recorded.
See https://github.com/hughw19/NOCS_CVPR2019.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from perception.errors import InvalidInputError
from perception.io.scan_folder import FRAME_PERIOD, read_png
from perception.types import CameraIntrinsics, Category, ObjectDetection, RgbdFrame

REAL275 = (591.0125, 590.16775, 322.525, 244.11084)  # fx, fy, cx, cy [px at 640x480] of the real sequences
CLASSES: dict[int, Category] = {1: "bottle", 2: "bowl", 4: "can", 6: "mug"}  # 3 and 5: camera, laptop
BACKGROUND = 255
_COLOR = re.compile(r"(\d+)_color\.png")


@dataclass(frozen=True)
class NocsRecording:
    """A folder of frames, their numbers in order, and the camera at 640 x 480."""

    folder: Path
    numbers: tuple[str, ...]
    camera: tuple[float, float, float, float]

    def read(self, index: int) -> RgbdFrame:
        """One frame, without a pose; InvalidInputError names the image that cannot be used."""
        number = self.numbers[index]
        rgb: UInt8[np.ndarray, "_h _w 3"] = _rgb(self.folder, f"{number}_color.png")
        raw = read_png(self.folder, f"{number}_depth.png", ("I;16", "I;16B", "I"), "16-bit grey")
        if raw.shape != rgb.shape[:2]:
            raise InvalidInputError(
                f"{self.folder / number}_depth.png and _color.png differ in size: register them"
            )
        height, width = raw.shape
        fx, fy, cx, cy = np.array(self.camera) * (width / 640.0)
        lens = CameraIntrinsics(width, height, float(fx), float(fy), float(cx), float(cy))
        return RgbdFrame(int(number) * FRAME_PERIOD, rgb, (raw / 1000.0).astype(np.float32), lens)

    def detections(self, index: int) -> list[ObjectDetection]:
        """The frame's masks of known classes; empty where it has no mask and meta file.

        Raises:
            InvalidInputError: one of the two is missing or malformed.
        """
        number = self.numbers[index]
        mask_name, meta = f"{number}_mask.png", self.folder / f"{number}_meta.txt"
        if not (self.folder / mask_name).exists() and not meta.exists():
            return []
        instances = read_png(self.folder, mask_name, ("L", "P", "RGB", "RGBA"), "8-bit grey")
        instances = instances if instances.ndim == 2 else instances[..., 0]
        found = []
        for instance, kind in _read_meta(meta):
            mask = instances == instance
            if kind in CLASSES and instance != BACKGROUND and mask.any():
                found.append(ObjectDetection(CLASSES[kind], 1.0, mask, instance_id=instance))
        return found


def is_nocs_recording(folder: Path) -> bool:
    return next(folder.glob("*_color.png"), None) is not None


def open_nocs(folder: Path, camera: tuple[float, float, float, float] = REAL275) -> NocsRecording:
    """Lists the frames that have colour and depth.

    Raises:
        InvalidInputError: there is none.
    """
    names = sorted(match.group(1) for path in folder.iterdir() if (match := _COLOR.fullmatch(path.name)))
    numbers = tuple(number for number in names if (folder / f"{number}_depth.png").exists())
    if not numbers:
        raise InvalidInputError(
            f"{folder} holds no frame with both <number>_color.png and <number>_depth.png"
        )
    return NocsRecording(folder, numbers, camera)


def _rgb(folder: Path, name: str) -> np.ndarray:
    pixels = read_png(folder, name, ("RGB", "RGBA"), "8-bit RGB")
    return np.ascontiguousarray(pixels[..., :3])


def _read_meta(path: Path) -> list[tuple[int, int]]:
    """(instance, class) of each line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{path} cannot be read ({error}): it tells the masks' classes") from None
    entries = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            entries.append((int(words[0]), int(words[1])))
        except (ValueError, IndexError):
            raise InvalidInputError(
                f"{path}, line {number}: expected an instance and a class number"
            ) from None
    return entries
