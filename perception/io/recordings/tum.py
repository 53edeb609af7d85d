"""TUM RGB-D recordings: ``rgb.txt`` and ``depth.txt`` list image files with their times, depth in 1/5000 m.

https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. Colour and depth are registered but not
synchronised: each depth image is paired with the colour image nearest in time. The camera (freiburg1, 2 or 3)
is recognised by the folder's name or the comments of ``rgb.txt``; a file of intrinsics takes precedence, such
as ``intrinsics.txt`` with ``fx fy cx cy``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from perception.errors import InvalidInputError
from perception.io.files import read_text
from perception.io.recordings.camera_files import find_camera
from perception.io.recordings.image_pairs import ImagePair, NominalCamera, read_pair
from perception.io.scan_cameras import MAX_TIME
from perception.io.scan_folder import MAX_SEQUENCE
from perception.types import RgbdFrame

UNITS_PER_METRE = 5000.0  # of the depth images
MAX_TIME_DIFFERENCE = 0.02  # [s] between a depth image and its colour image

# Calibrated cameras, from the data set's page.
CAMERAS = {
    "freiburg1": NominalCamera(517.3, 516.5, 318.6, 255.3),
    "freiburg2": NominalCamera(520.9, 521.0, 325.1, 249.7),
    "freiburg3": NominalCamera(535.4, 539.2, 320.1, 247.6),
}
DEFAULT_CAMERA = NominalCamera(525.0, 525.0, 319.5, 239.5)  # recommended for all others


@dataclass(frozen=True)
class TumRecording:
    """A TUM RGB-D recording.

    Attributes:
        folder: Its folder.
        pairs: Paired images by ascending time of the depth image.
        camera: Its camera.
        units_per_metre: Unit of its depth images.
        n_missing: Number of pairs in the lists that lack an image file.
    """

    folder: Path
    pairs: tuple[ImagePair, ...]
    camera: NominalCamera
    units_per_metre: float = UNITS_PER_METRE
    n_missing: int = 0

    def read(self, index: int) -> RgbdFrame:
        """Read one frame, without a pose; raises InvalidInputError as ``read_pair``."""
        return read_pair(self.folder, self.pairs[index], self.camera, self.units_per_metre)


def is_tum_recording(folder: Path) -> bool:
    """Return whether the folder has the two lists of a TUM RGB-D recording."""
    return (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file()


def open_tum(folder: Path) -> TumRecording:
    """Read the lists of a recording and pair its images; pairs without image files are left out.

    Raises:
        InvalidInputError: A list is malformed, no depth image has a colour image within MAX_TIME_DIFFERENCE,
            or no listed image exists.
    """
    colors, depths = (_read_list(folder / name) for name in ("rgb.txt", "depth.txt"))
    times = np.array([time for time, _ in colors])
    pairs, used = [], set()
    for time, depth in depths:
        nearest = _nearest(times, time)
        if abs(times[nearest] - time) <= MAX_TIME_DIFFERENCE and nearest not in used:
            used.add(nearest)
            pairs.append(ImagePair(time, colors[nearest][1], depth))
    if not pairs:
        limit = f"{1000 * MAX_TIME_DIFFERENCE:.0f} ms"
        raise InvalidInputError(
            f"{folder}: no depth image has a colour image within {limit}; check the lists"
        )
    present = tuple(p for p in pairs if (folder / p.color).exists() and (folder / p.depth).exists())
    if not present:
        raise InvalidInputError(
            f"{folder} has none of the {len(pairs)} listed image pairs, such as {pairs[0].color} and "
            f"{pairs[0].depth}"
        )
    return TumRecording(folder, present, _camera(folder), n_missing=len(pairs) - len(present))


def _nearest(times: Float[np.ndarray, "n"], time: float) -> int:
    """Return the index of the first of the ascending times in [s] that is nearest to a time."""
    after = min(int(np.searchsorted(times, time)), len(times) - 1)
    before = max(after - 1, 0)
    nearest = before if abs(times[before] - time) <= abs(times[after] - time) else after
    return int(np.searchsorted(times, times[nearest]))


def _camera(folder: Path) -> NominalCamera:
    """Return the stated camera, else that of the data set's room, else the recommended one."""
    if (stated := find_camera(folder)) is not None:
        return stated
    comments = [line for line in read_text(folder / "rgb.txt").splitlines() if line.startswith("#")]
    names = "\n".join([folder.name, folder.resolve().name, *comments])
    return next((camera for name, camera in CAMERAS.items() if name in names), DEFAULT_CAMERA)


def _read_list(path: Path) -> list[tuple[float, str]]:
    """Return the (time, file name) pairs of a list by ascending time."""
    entries = []
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(f"{path} cannot be read ({error}): it lists the images") from None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            time = float(words[0])
            if not abs(time) <= MAX_TIME:
                raise ValueError(words[0])
            entries.append((time, words[1]))
        except (ValueError, IndexError):
            raise InvalidInputError(
                f"{path}, line {number}: expected a time in seconds and a file name"
            ) from None
    if not entries:
        raise InvalidInputError(f"{path} lists no image: it needs one line per image")
    if len(entries) > MAX_SEQUENCE:
        raise InvalidInputError(
            f"{path} lists {len(entries)} images, at most {MAX_SEQUENCE} are read: divide the recording"
        )
    return sorted(entries)
