"""Two colours in one mask are two objects if one is above the other; labels, stripes and shading are not."""

import numpy as np
import pytest

from perception.inference.color_cuts import color_cut, color_pieces
from perception.inference.observation import ObjectObservation
from perception.types import CameraIntrinsics, RgbdFrame, SupportPlane

CAMERA = CameraIntrinsics(64, 64, 80.0, 80.0, 31.5, 31.5)
BROWN, PINK = np.array([130, 70, 30]), np.array([230, 110, 150])
SEAM = 34  # first row of the lower object
PLANE = SupportPlane()


def view(colors: np.ndarray, noise: float = 6.0) -> ObjectObservation:
    """A wall 0.5 m before a level camera at a height of 0.1 m, in the middle of the image."""
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[2, 3] = 0.1
    mask = np.zeros((64, 64), bool)
    mask[16:48, 20:44] = True
    rgb = np.full((64, 64, 3), 200.0)
    rgb[mask] = colors[mask] + np.random.default_rng(0).normal(0, noise, (int(mask.sum()), 3))
    frame = RgbdFrame(
        0.0, np.clip(rgb, 0, 255).astype(np.uint8), np.full((64, 64), 0.5, np.float32), CAMERA, T
    )
    return ObjectObservation(frame, mask)


def painted(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    rows = np.arange(64)[:, None, None]
    return np.where(rows < SEAM, upper, lower) * np.ones((64, 64, 1))


def test_the_upper_object_is_parted_from_the_lower_one() -> None:
    seen = {0: view(painted(PINK, BROWN)), 3: view(painted(PINK, BROWN))}
    cut = color_cut(seen, PLANE)
    assert cut is not None and list(cut.masks) == [0, 3]
    for lower, upper in cut.masks.values():
        rows = np.arange(64)[:, None]
        np.testing.assert_array_equal(upper, seen[0].mask & (rows < SEAM))
        np.testing.assert_array_equal(lower, seen[0].mask & (rows >= SEAM))
    assert cut.height == pytest.approx(0.1 + 0.5 / 80 * (31.5 - SEAM), abs=0.01)


def test_groups_are_those_of_all_views_together() -> None:
    """A view of the lower object alone has no two colours of its own."""
    cut = color_cut({0: view(painted(PINK, BROWN)), 1: view(painted(BROWN, BROWN))}, PLANE)
    assert cut is not None
    lower, upper = cut.masks[1]
    assert lower.sum() == 32 * 24 and not upper.any()


def test_what_has_one_colour_is_one_object() -> None:
    assert color_cut({0: view(painted(BROWN, BROWN))}, PLANE) is None
    assert color_cut({0: view(painted(BROWN, 0.6 * BROWN))}, PLANE) is None, "its lower half is in the shade"
    assert color_cut({0: view(painted(PINK, BROWN), noise=70.0)}, PLANE) is None, "speckled"


def test_stripes_and_patterns_are_no_objects() -> None:
    rows, columns = np.arange(64)[:, None, None], np.arange(64)[None, :, None]
    stripes = np.where(rows // 6 % 2, PINK, BROWN) * np.ones((64, 64, 1))
    beside = np.where(columns < 32, PINK, BROWN) * np.ones((64, 64, 1))
    for colors in (stripes, beside):
        assert color_cut({0: view(colors)}, PLANE) is None


def test_pieces_of_two_colours_may_be_beside_each_other() -> None:
    """Spots of the other colour belong to the piece that they are in."""
    columns = np.arange(64)[None, :]
    beside = np.where(columns[..., None] < 32, PINK, BROWN) * np.ones((64, 64, 1))
    beside[24:29, 24:29] = BROWN
    pieces = color_pieces({0: view(beside), 2: view(painted(BROWN, BROWN))})
    assert pieces is not None and set(pieces) == {0, 2}
    left, right = sorted(pieces[0], key=lambda mask: np.argwhere(mask)[:, 1].mean())
    mask = view(beside).mask
    assert (left ^ (mask & (columns < 32))).sum() <= 8, "but for pixels at its corners"
    assert (right ^ (mask & (columns >= 32))).sum() <= 8
    assert sorted(int(m.sum()) for m in pieces[2]) == [0, 32 * 24], "the other view shows one of them alone"
    assert color_pieces({0: view(painted(BROWN, BROWN))}) is None
