"""RGB-D sequences read one frame at a time: scan folders and TUM RGB-D recordings.

All camera poses but the first are dropped: they must not be available to tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from perception.errors import InvalidInputError
from perception.io.detections import Entry, decode_detections, read_detection_entries
from perception.io.recordings.tum import is_tum_recording, open_tum
from perception.io.scan_folder import ScanIndex
from perception.types import ObjectDetection, RgbdFrame

Read = Callable[[int], RgbdFrame]


@dataclass(frozen=True)
class RgbdSequence:
    """Frames in temporal order.

    Attributes:
        path: Folder of the sequence.
        ids: Id of each frame.
        read: Reads the frame of an id.
        entries: Encoded detections by frame id; None without ``detections.json``.
    """

    path: Path
    ids: Sequence[int]
    read: Read
    entries: Mapping[int, list[Entry]] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def frames(self) -> Iterator[tuple[int, RgbdFrame | InvalidInputError]]:
        """Yield (id, frame) in temporal order; for an unusable image the error instead of the frame."""
        for index, id in enumerate(self.ids):
            try:
                frame = self.read(id)
            except InvalidInputError as error:
                yield id, error
                continue
            yield id, frame if index == 0 else without_pose(frame)

    def detections(self, id: int, frame: RgbdFrame) -> list[ObjectDetection] | None:
        """Return the recorded detections of a frame; None if the sequence has no detections.

        Raises:
            InvalidInputError: An entry is invalid; the message names it and the problem.
        """
        if self.entries is None:
            return None
        return decode_detections(self.path, self.entries.get(id, []), id, frame)


def without_pose(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame without its camera pose."""
    return RgbdFrame(frame.time, frame.rgb, frame.depth, frame.intrinsics)


def open_sequence(path: Path) -> RgbdSequence:
    """Open a scan folder or a TUM RGB-D recording.

    Raises:
        InvalidInputError: The folder is neither, or its index is invalid.
    """
    if not path.is_dir():
        raise InvalidInputError(f"{path} is no folder: give a scan folder or a TUM RGB-D recording")
    if (path / "scene_camera.json").is_file():
        index = ScanIndex.of(path)
        return RgbdSequence(path, index.ids, index.read, read_detection_entries(path, set(index.ids)))
    if is_tum_recording(path):
        recording = open_tum(path)
        return RgbdSequence(path, range(len(recording.pairs)), recording.read)
    raise InvalidInputError(
        f"{path} holds neither scene_camera.json (a scan folder) nor rgb.txt and depth.txt (TUM RGB-D): "
        "nodeslam convert makes scan folders of other recordings"
    )
