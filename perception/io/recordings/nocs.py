"""NOCS recordings (REAL275, CAMERA25): ``0000_color.png``, ``_depth.png``, ``_mask.png``, ``_meta.txt``.

Depth is 16-bit in millimetres. The mask holds the instance number of each pixel, 255 for background; each
line of the meta file states an instance's class: ``<instance> <class> <model>``. Camera poses are not
recorded. See https://github.com/hughw19/NOCS_CVPR2019.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from perception.errors import InvalidInputError
from perception.io.detections import MAX_PER_IMAGE
from perception.io.files import read_text
from perception.io.images import read_image
from perception.io.recordings.image_pairs import ImagePair, NominalCamera, read_pair
from perception.io.scan_folder import FRAME_PERIOD
from perception.types import Category, ObjectDetection, RgbdFrame

UNITS_PER_METRE = 1000.0  # of the depth images
REAL275 = NominalCamera(591.0125, 590.16775, 322.525, 244.11084)  # camera of the real sequences
CLASSES: dict[int, Category] = {1: "bottle", 2: "bowl", 4: "can", 6: "mug"}  # 3: camera, 5: laptop
BACKGROUND = 255
_COLOR = re.compile(r"(\d+)_color\.png")


@dataclass(frozen=True)
class NocsRecording:
    """A NOCS recording.

    Attributes:
        folder: Its folder.
        numbers: Numbers of its frames, as in the file names, in ascending order.
        camera: Its camera.
        units_per_metre: Unit of its depth images.
    """

    folder: Path
    numbers: tuple[str, ...]
    camera: NominalCamera
    units_per_metre: float = UNITS_PER_METRE

    def read(self, index: int) -> RgbdFrame:
        """Read one frame, without a pose; raises InvalidInputError as ``read_pair``."""
        number = self.numbers[index]
        pair = ImagePair(int(number) * FRAME_PERIOD, f"{number}_color.png", f"{number}_depth.png")
        return read_pair(self.folder, pair, self.camera, self.units_per_metre)

    def detections(self, index: int) -> list[ObjectDetection]:
        """Return the true masks of a frame's objects of known classes; none without mask and meta file.

        Raises:
            InvalidInputError: One of the two files is missing or malformed.
        """
        number = self.numbers[index]
        mask_name, meta = f"{number}_mask.png", self.folder / f"{number}_meta.txt"
        if not (self.folder / mask_name).exists() and not meta.exists():
            return []
        instances = read_image(self.folder, mask_name, ("L", "P", "RGB", "RGBA"), "8-bit grey")
        instances = instances if instances.ndim == 2 else instances[..., 0]
        size = read_image(self.folder, f"{number}_color.png", ("RGB", "RGBA"), "8-bit RGB").shape[:2]
        if instances.shape != size:
            raise InvalidInputError(
                f"{self.folder / mask_name} is {instances.shape[1]}x{instances.shape[0]} but its image is "
                f"{size[1]}x{size[0]}"
            )
        found = []
        for instance, class_id in _read_meta(meta):
            mask = instances == instance
            if class_id in CLASSES and instance != BACKGROUND and mask.any():
                found.append(ObjectDetection(CLASSES[class_id], 1.0, mask, instance_id=instance))
        return found


def is_nocs_recording(folder: Path) -> bool:
    """Return whether the folder has a NOCS colour image."""
    return any(_COLOR.fullmatch(path.name) for path in folder.glob("*_color.png"))


def open_nocs(folder: Path, camera: NominalCamera = REAL275) -> NocsRecording:
    """List the frames of a recording that have both colour and depth.

    Raises:
        InvalidInputError: There is none.
    """
    names = sorted(match.group(1) for path in folder.iterdir() if (match := _COLOR.fullmatch(path.name)))
    numbers = tuple(number for number in names if (folder / f"{number}_depth.png").exists())
    if not numbers:
        raise InvalidInputError(
            f"{folder} holds no frame with both <number>_color.png and <number>_depth.png"
        )
    return NocsRecording(folder, numbers, camera)


def _read_meta(path: Path) -> list[tuple[int, int]]:
    """Return the (instance, class) numbers of each line."""
    try:
        lines = read_text(path).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInputError(
            f"{path} cannot be read ({error}): it states the classes of the masks"
        ) from None
    entries = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            instance, class_id = int(words[0]), int(words[1])
        except (ValueError, IndexError):
            raise InvalidInputError(
                f"{path}, line {number}: expected an instance and a class number"
            ) from None
        if instance in dict(entries):
            raise InvalidInputError(f"{path}, line {number}: instance {instance} is listed twice")
        entries.append((instance, class_id))
    if len(entries) > MAX_PER_IMAGE:
        raise InvalidInputError(f"{path} lists {len(entries)} instances, at most {MAX_PER_IMAGE} are allowed")
    return entries
