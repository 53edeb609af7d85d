"""Image files: accepted types, sizes and places."""

import os

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.io.images import DEPTH_MODES, MAX_IMAGE_BYTES, MAX_IMAGE_SIDE, png_bytes, read_image


@pytest.mark.parametrize(
    ("image", "modes"),
    [
        (np.arange(24, dtype=np.uint8).reshape(2, 4, 3), ("RGB",)),
        (np.array([[0, 1, 65535]], np.uint16), DEPTH_MODES),
        (np.array([[0, 255]], np.uint8), ("L",)),
    ],
)
def test_png_round_trip(tmp_path, image, modes):
    (tmp_path / "a.png").write_bytes(png_bytes(image))
    np.testing.assert_array_equal(read_image(tmp_path, "a.png", modes, "any"), image)


def test_a_wrong_pixel_type_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(png_bytes(np.zeros((2, 2), np.uint8)))
    with pytest.raises(InvalidInputError, match=r"a\.png must be 16-bit grey, its pixels are of type 'L'"):
        read_image(tmp_path, "a.png", DEPTH_MODES, "16-bit grey")


def test_images_wider_than_the_limit_are_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(png_bytes(np.zeros((1, MAX_IMAGE_SIDE + 1), np.uint8)))
    with pytest.raises(InvalidInputError, match=rf"is {MAX_IMAGE_SIDE + 1}x1; at most {MAX_IMAGE_SIDE} px"):
        read_image(tmp_path, "a.png", ("L",), "8-bit grey")


def test_missing_and_outside_images_are_refused(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "a.png").write_bytes(png_bytes(np.zeros((2, 2), np.uint8)))
    with pytest.raises(InvalidInputError, match=r"a\.png is missing"):
        read_image(tmp_path / "in", "a.png", ("L",), "8-bit grey")
    with pytest.raises(InvalidInputError, match="leads out of the scan folder"):
        read_image(tmp_path / "in", "../a.png", ("L",), "8-bit grey")


def test_a_file_that_is_no_image_is_named_by_its_path(tmp_path):
    (tmp_path / "a.png").write_text("no image")
    with pytest.raises(InvalidInputError) as caught:
        read_image(tmp_path, "a.png", ("L",), "8-bit grey")
    message = f"{tmp_path / 'a.png'} is not a readable PNG (no PNG header): record or copy it again"
    assert str(caught.value) == message


def test_pipes_and_large_files_are_refused(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    with pytest.raises(InvalidInputError, match=r"a\.png is a named pipe, not a regular file"):
        read_image(tmp_path, "a.png", ("L",), "8-bit grey")
    with (tmp_path / "b.png").open("wb") as file:
        file.truncate(MAX_IMAGE_BYTES + 1)
    with pytest.raises(InvalidInputError, match=r"b\.png is too large"):
        read_image(tmp_path, "b.png", ("L",), "8-bit grey")


@pytest.mark.parametrize("name", ["x" * 300 + ".png", "loop.png", "a\0b.png"])
def test_impossible_names_are_refused(tmp_path, name):
    (tmp_path / "loop.png").symlink_to("loop.png")
    with pytest.raises(InvalidInputError, match=r"is missing|is not a readable PNG"):
        read_image(tmp_path, name, ("L",), "8-bit grey")
