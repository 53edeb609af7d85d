"""Image files: accepted types, sizes and places."""

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.io.images import DEPTH_MODES, MAX_IMAGE_SIDE, png_bytes, read_image


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
