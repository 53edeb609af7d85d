"""RGB-D sequences read one frame at a time: scan folders, and TUM RGB-D recordings.

Camera poses are dropped, all but the first: whoever tracks the camera is not to know them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.errors import InvalidInputError
from perception.io.detections import decode_detections, group_detections
from perception.io.recordings.tum import is_tum_recording, open_tum
from perception.io.scan_folder import ScanIndex
from perception.types import ObjectDetection, RgbdFrame

Read = Callable[[int], RgbdFrame]


@dataclass(frozen=True)
class RgbdSequence:
    """Frames in the order of their times.

    Attributes:
        path: the folder.
        ids: number of each frame in the folder.
        read: a frame by its number.
        entries: detections by frame number, as they stand in ``detections.json``; None where there is none.
    """

    path: Path
    ids: Sequence[int]
    read: Read
    entries: Mapping[int, list[Any]] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def frames(self) -> Iterator[tuple[int, RgbdFrame | InvalidInputError]]:
        """Number and frame; for an unreadable one what is wrong with it."""
        for order, number in enumerate(self.ids):
            try:
                frame = self.read(number)
            except InvalidInputError as error:
                yield number, error
                continue
            yield number, frame if order == 0 else without_pose(frame)

    def detections(self, number: int, frame: RgbdFrame) -> list[ObjectDetection] | None:
        """The folder's own detections of a frame, or None where it has none at all."""
        if self.entries is None:
            return None
        return decode_detections(self.path, self.entries.get(number, []), number, frame)


def without_pose(frame: RgbdFrame) -> RgbdFrame:
    """The frame as an unknown camera took it."""
    return RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)


def open_sequence(path: Path) -> RgbdSequence:
    """A scan folder or a TUM RGB-D recording.

    Raises:
        InvalidInputError: it is neither, or its index is bad; the message says what to give.
    """
    if not path.is_dir():
        raise InvalidInputError(f"{path} is no folder: give a scan folder or a TUM RGB-D recording")
    if (path / "scene_camera.json").is_file():
        index = ScanIndex.of(path)
        return RgbdSequence(path, index.ids, index.read, group_detections(path, set(index.ids)))
    if is_tum_recording(path):
        recording = open_tum(path)
        return RgbdSequence(path, range(len(recording.pairs)), recording.read)
    raise InvalidInputError(
        f"{path} holds neither scene_camera.json (a scan folder) nor rgb.txt and depth.txt (TUM RGB-D)"
    )
