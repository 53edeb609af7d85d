"""How alike parts are in colour."""

import numpy as np
import pytest

from perception.inference.part_colors import ALIKE, color_overlap
from perception.types import CameraIntrinsics, RgbdFrame

CAMERA = CameraIntrinsics(40, 20, 40.0, 40.0, 19.5, 9.5)
LEFT = np.zeros((20, 40), bool)
LEFT[:, :20] = True


def image(left, right, noise=0.0):
    """An image of two colours."""
    rgb = np.where(LEFT[..., None], left, right) + noise * np.random.default_rng(0).standard_normal(
        (20, 40, 3)
    )
    return RgbdFrame(0.0, np.clip(rgb, 0, 255).astype(np.uint8), np.ones((20, 40), np.float32), CAMERA)


def overlap(*images):
    return color_overlap([(frame, LEFT) for frame in images], [(frame, ~LEFT) for frame in images])


def test_one_color_overlaps_with_itself_and_not_with_another():
    assert overlap(image((200, 40, 40), (200, 40, 40))) == pytest.approx(1.0)
    assert overlap(image((200, 40, 40), (40, 40, 200))) == 0.0


def test_the_overlap_is_the_smaller_of_the_shares_over_all_images():
    """One part is red and blue in equal shares, the other one red."""
    assert overlap(image((200, 40, 40), (200, 40, 40)), image((40, 40, 200), (200, 40, 40))) == pytest.approx(
        0.5
    )


@pytest.mark.parametrize("gray", range(100, 140, 4))
def test_noise_and_shading_leave_a_color_alike(gray):
    """Wherever it is between the edges of the cells."""
    red = np.array([gray, 40.0, 40.0])
    assert overlap(image(red, 0.9 * red, noise=4.0)) > ALIKE


def test_a_part_that_no_image_shows_is_like_none():
    assert color_overlap([], [(image((9, 9, 9), (9, 9, 9)), LEFT)]) == 0.0
