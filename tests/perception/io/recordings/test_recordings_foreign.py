"""Other people's recordings: masks beside the images, NOCS frames, JPEG colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from perception.errors import InvalidInputError
from perception.io.recordings.nocs import CLASSES, REAL275, is_nocs_recording, open_nocs
from perception.io.scan_folder import png_bytes, read_scan, write_scan
from perception.types import CameraIntrinsics, RgbdFrame

H, W = 48, 64
LENS = CameraIntrinsics(W, H, 60.0, 60.0, 31.5, 23.5)


def frame(number: int = 0) -> RgbdFrame:
    rgb = np.full((H, W, 3), 90 + number, np.uint8)
    return RgbdFrame(float(number), rgb, np.full((H, W), 0.7, np.float32), LENS)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(png_bytes(image))


def blob(left: int) -> np.ndarray:
    mask = np.zeros((H, W), np.uint8)
    mask[10:20, left : left + 8] = 255
    return mask


@pytest.fixture
def bop(tmp_path: Path) -> Path:
    """Two images without poses, the first with two masks."""
    write_scan(tmp_path / "bop", [frame(0), frame(1)])
    save(tmp_path / "bop/mask/000000_000000.png", np.full((H, W), 255, np.uint8))
    for number, left in enumerate((5, 30)):
        save(tmp_path / f"bop/mask_visib/000000_{number:06d}.png", blob(left))
    return tmp_path / "bop"


def test_masks_beside_the_images_are_read_and_the_visible_ones_preferred(bop: Path) -> None:
    scan = read_scan(bop)
    assert scan.detections is None and scan.masks is not None and not scan.has_poses
    assert [len(masks) for masks in scan.masks] == [2, 0]
    np.testing.assert_array_equal(scan.masks[0][1], blob(30) > 0)


def test_without_mask_folders_there_are_no_masks(tmp_path: Path) -> None:
    write_scan(tmp_path / "scan", [frame()])
    assert read_scan(tmp_path / "scan").masks is None


def test_a_mask_of_another_size_or_name_is_named(bop: Path) -> None:
    save(bop / "mask_visib/000001_000000.png", np.full((H, W + 2), 255, np.uint8))
    with pytest.raises(InvalidInputError, match=r"000001_000000.png is 66x48 but its image is 64x48"):
        read_scan(bop)
    (bop / "mask_visib/000001_000000.png").rename(bop / "mask_visib/cup.png")
    with pytest.raises(InvalidInputError, match=r"masks are named <image>_<number>\.png"):
        read_scan(bop)


def test_jpeg_colour_is_read_and_a_broken_one_named(tmp_path: Path) -> None:
    write_scan(tmp_path / "scan", [frame()])
    (tmp_path / "scan/rgb/000000.png").unlink()
    Image.fromarray(frame().rgb).save(tmp_path / "scan/rgb/000000.jpg", quality=95)
    read = read_scan(tmp_path / "scan").frames[0]
    assert np.abs(read.rgb.astype(int) - 90).max() <= 2
    (tmp_path / "scan/rgb/000000.jpg").write_bytes(b"\xff\xd8 no picture")
    with pytest.raises(InvalidInputError, match=r"000000\.jpg is not a readable JPEG"):
        read_scan(tmp_path / "scan")


@pytest.fixture
def nocs(tmp_path: Path) -> Path:
    """Two frames: a mug, a laptop and a bowl in the first, nothing told of the second."""
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
    (nocs / "0000_meta.txt").unlink()
    with pytest.raises(InvalidInputError, match=r"0000_meta\.txt cannot be read"):
        open_nocs(nocs).detections(0)
    save(nocs / "0001_depth.png", np.full((240, 320), 850, np.uint16))
    with pytest.raises(InvalidInputError, match="differ in size"):
        open_nocs(nocs).read(1)
    (nocs / "0000_depth.png").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(InvalidInputError, match="not a readable PNG"):
        open_nocs(nocs).read(0)
    with pytest.raises(InvalidInputError, match="holds no frame"):
        open_nocs(tmp_path)
