"""NOCS recordings: units, camera, true masks of known classes, malformed folders."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.io.images import png_bytes
from perception.io.recordings.nocs import CLASSES, REAL275, is_nocs_recording, open_nocs


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(image))


@pytest.fixture
def nocs(tmp_path: Path) -> Path:
    """Two frames: a mug, a laptop and a bowl in the first, no detections in the second."""
    folder = tmp_path / "scene_1"
    for number in range(2):
        save(folder / f"{number:04d}_color.png", np.full((480, 640, 3), 100 + number, np.uint8))
        save(folder / f"{number:04d}_depth.png", np.full((480, 640), 850, np.uint16))
    mask = np.full((480, 640), 255, np.uint8)
    mask[100:150, 100:160], mask[200:220, 300:340], mask[300:350, 400:480] = 1, 2, 3
    save(folder / "0000_mask.png", mask)
    (folder / "0000_meta.txt").write_text("1 6 mug_daniel_norm\n2 5 laptop_air_norm\n3 2 bowl_white_norm\n")
    return folder


def test_nocs_frames_have_metres_the_data_sets_camera_and_known_classes(nocs: Path) -> None:
    assert is_nocs_recording(nocs)
    recording = open_nocs(nocs)
    assert recording.numbers == ("0000", "0001")
    read = recording.read(0)
    assert read.depth.max() == pytest.approx(0.85) and read.T_world_camera is None
    assert (read.intrinsics.fx, read.intrinsics.cy) == (REAL275[0], REAL275[3])
    found = {detection.category: detection for detection in recording.detections(0)}
    assert set(found) == {"mug", "bowl"} and CLASSES[6] == "mug"
    assert found["mug"].mask.sum() == 50 * 60 and found["bowl"].instance_id == 3
    assert recording.detections(1) == []


def test_malformed_nocs_folders_are_named(nocs: Path, tmp_path: Path) -> None:
    (nocs / "0000_meta.txt").write_text("1 mug\n")
    with pytest.raises(InvalidInputError, match=r"0000_meta.txt, line 1"):
        open_nocs(nocs).detections(0)
    (nocs / "0000_meta.txt").write_text("1 6 mug\n1 2 bowl\n")
    with pytest.raises(InvalidInputError, match=r"0000_meta.txt, line 2: instance 1 is listed twice"):
        open_nocs(nocs).detections(0)
    (nocs / "0000_meta.txt").write_text("".join(f"{i} 6 mug\n" for i in range(201)))
    with pytest.raises(InvalidInputError, match=r"0000_meta\.txt lists 201 instances, at most 200"):
        open_nocs(nocs).detections(0)
    (nocs / "0000_meta.txt").unlink()
    with pytest.raises(InvalidInputError, match=r"0000_meta\.txt cannot be read"):
        open_nocs(nocs).detections(0)
    (nocs / "0001_meta.txt").write_text("1 6 mug\n")
    save(nocs / "0001_mask.png", np.ones((240, 320), np.uint8))
    with pytest.raises(InvalidInputError, match=r"0001_mask\.png is 320x240 but its image is 640x480"):
        open_nocs(nocs).detections(1)
    save(nocs / "0001_depth.png", np.full((240, 320), 850, np.uint16))
    with pytest.raises(InvalidInputError, match="differ in size"):
        open_nocs(nocs).read(1)
    (nocs / "0000_depth.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InvalidInputError, match="not a readable PNG"):
        open_nocs(nocs).read(0)
    with pytest.raises(InvalidInputError, match="holds no frame"):
        open_nocs(tmp_path)
    save(tmp_path / "test_color.png", np.full((4, 4, 3), 1, np.uint8))
    assert not is_nocs_recording(tmp_path)  # no number
