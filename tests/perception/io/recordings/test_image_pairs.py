"""Frames from image pairs: units, camera, alpha channel, sizes."""

import numpy as np
import pytest
from PIL import Image

from perception.errors import InvalidInputError
from perception.io.recordings.image_pairs import ImagePair, NominalCamera, read_pair
from perception.types import CameraIntrinsics

CAMERA = NominalCamera(600.0, 610.0, 320.0, 240.0)
PAIR = ImagePair(1.5, "c.png", "d.png")


def write(folder, size=(4, 3), mode="RGB", depth_size=None):
    Image.new(mode, size, (10, 20, 30, 40)[: len(mode)]).save(folder / "c.png")
    shape = (depth_size or size)[::-1]
    Image.fromarray(np.full(shape, 2500, np.uint16)).save(folder / "d.png")


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_a_pair_is_a_frame_in_metres_without_pose(tmp_path, mode):
    write(tmp_path, mode=mode)
    frame = read_pair(tmp_path, PAIR, CAMERA, 5000.0)
    assert frame.time == 1.5 and frame.T_world_camera is None
    assert (frame.rgb == (10, 20, 30)).all() and frame.rgb.shape == (3, 4, 3)
    np.testing.assert_allclose(frame.depth, 0.5)


def test_intrinsics_scale_with_the_width():
    assert CAMERA.intrinsics(320, 240) == CameraIntrinsics(320, 240, 300.0, 305.0, 160.0, 120.0)
    assert CAMERA.intrinsics(640, 480) == CameraIntrinsics(640, 480, 600.0, 610.0, 320.0, 240.0)


def test_a_camera_of_the_images_own_width_is_not_scaled():
    own = NominalCamera(600.0, 610.0, 700.0, 240.0, width=0)
    assert own.intrinsics(1280, 720) == CameraIntrinsics(1280, 720, 600.0, 610.0, 700.0, 240.0)
    with pytest.raises(InvalidInputError, match=r"\(700, 240\) lies outside the images of 640x480 px"):
        own.intrinsics(640, 480)


def test_saturated_depth_is_no_measurement(tmp_path):
    write(tmp_path)
    raw = np.full((3, 4), 2500, np.uint16)
    raw[0, 0], raw[1, 1] = 65535, 0
    Image.fromarray(raw).save(tmp_path / "d.png")
    depth = read_pair(tmp_path, PAIR, CAMERA, 1000.0).depth
    assert depth[0, 0] == 0 and depth[1, 1] == 0 and depth[2, 2] == pytest.approx(2.5)


def test_images_of_different_sizes_are_refused(tmp_path):
    write(tmp_path, depth_size=(4, 4))
    words = r"d\.png \(4x4\) and c\.png \(4x3\) differ in size: register depth to colour"
    with pytest.raises(InvalidInputError, match=words):
        read_pair(tmp_path, PAIR, CAMERA, 1000.0)
