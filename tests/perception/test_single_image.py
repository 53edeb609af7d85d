"""Images given as arrays: units, shapes, missing depth, and the messages of invalid arrays."""

import numpy as np
import pytest

from perception import single_image
from perception.errors import InvalidInputError
from perception.single_image import image_frame

COLOR = np.zeros((4, 6, 3), np.uint8)
DEPTH = np.full((4, 6), 0.75, np.float64)
K = np.array([[5.0, 0, 2.5], [0, 6.0, 1.5], [0, 0, 1]])


def test_a_valid_image_becomes_a_frame():
    pose = np.eye(4)
    frame = image_frame(COLOR, DEPTH, K, pose)
    k = frame.intrinsics
    assert (k.width, k.height, k.fx, k.fy, k.cx, k.cy) == (6, 4, 5.0, 6.0, 2.5, 1.5)
    assert frame.depth.dtype == np.float32 and (frame.depth == np.float32(0.75)).all()
    np.testing.assert_array_equal(frame.T_world_camera, pose)
    assert image_frame(COLOR, DEPTH, K).T_world_camera is None


def test_uint16_depth_is_in_millimetres():
    depth = np.array([[0, 750] * 3] * 4, np.uint16)
    np.testing.assert_allclose(image_frame(COLOR, depth, K).depth[0, :2], (0.0, 0.75))


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_nan_infinite_zero_and_negative_depth_is_missing(dtype):
    depth = np.tile(np.array([np.nan, np.inf, -np.inf, 0, -0.5, 0.75], dtype), (4, 1))
    frame = image_frame(COLOR, depth, K)
    np.testing.assert_array_equal(frame.depth, np.tile([0, 0, 0, 0, 0, np.float32(0.75)], (4, 1)))
    assert np.isnan(depth[0, 0])  # the argument is unchanged


def test_missing_pixels_do_not_enter_the_test_of_the_unit():
    depth = np.where(np.eye(4, 6) > 0, 750.0, np.inf)
    with pytest.raises(InvalidInputError, match="the median depth of 750 m cannot be in metres"):
        image_frame(COLOR, depth, K)
    assert image_frame(COLOR, DEPTH * 0 + 100.0, K).depth.max() == 100.0  # the limit


def test_camera_matrices_may_be_nested_lists_of_integers():
    assert image_frame(COLOR, DEPTH, [[5, 0, 2], [0, 6, 1], [0, 0, 1]]).intrinsics.fy == 6.0


@pytest.mark.parametrize(
    "change, message",
    [
        ({"color": COLOR / 255}, r"color must be \(H, W, 3\) uint8 RGB, got \(4, 6, 3\) float64"),
        ({"color": COLOR[..., 0]}, r"color must be \(H, W, 3\) uint8 RGB, got \(4, 6\) uint8"),
        (
            {"depth": DEPTH[:2]},
            r"depth is \(2, 6\) but color is \(4, 6\): register and resize depth to color",
        ),
        ({"depth": DEPTH.astype(np.int32)}, "depth must be float metres or uint16 millimetres, got int32"),
        ({"depth": DEPTH * np.nan}, "depth has no measurement: every pixel is NaN, infinite, zero or neg"),
        ({"depth": np.zeros((4, 6), np.uint16)}, "depth has no measurement"),
        ({"depth": -DEPTH}, "depth has no measurement"),
        ({"depth": DEPTH * 1000}, "median depth of 750 m cannot be in metres: divide millimetres by 1000"),
        ({"K": K[:2]}, r"K must be a finite \(3, 3\) camera matrix, got \(2, 3\) float64"),
        ({"K": K * np.nan}, r"K must be a finite \(3, 3\) camera matrix"),
        ({"K": K + np.eye(3)[[1, 0, 2]]}, "a camera without skew"),
        ({"K": 2 * K}, "a camera without skew"),
        ({"K": -K + 2 * np.diag([0, 0, 1])}, "focal lengths -5.0, -6.0 px must be positive"),
        ({"T_world_camera": np.eye(3)}, "T_world_camera must be a finite 4x4 matrix"),
    ],
)
def test_unusable_arrays_are_named(change, message):
    with pytest.raises(InvalidInputError, match=message):
        image_frame(**({"color": COLOR, "depth": DEPTH, "K": K} | change))


def test_the_image_goes_through_reconstruction_as_one_frame(monkeypatch):
    monkeypatch.setattr(single_image, "reconstruct", lambda frames, perception: (frames, perception))
    frames, perception = single_image.reconstruct_image.__wrapped__(COLOR, DEPTH, K, np.eye(4))
    assert len(frames) == 1 and perception is None and frames[0].T_world_camera is not None
