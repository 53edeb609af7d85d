import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perception.errors import InvalidInputError
from perception.io.scan_cameras import (
    MAX_DISTANCE,
    camera_entry,
    check_camera,
    read_intrinsics,
    read_numbers,
    read_pose,
    suspicion_of_metres,
)
from perception.types import CameraIntrinsics, RgbdFrame


def frame(T=None, f=60.0):
    camera = CameraIntrinsics(64, 48, f, f, 32.0, 24.0)
    return RgbdFrame(0.5, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera, T)


def pose(x, rotation=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[0, 3] = x
    return T


@given(st.tuples(*3 * [st.floats(-3, 3)]), st.floats(-99, 99))
def test_an_entry_comes_back_as_it_was(rotation, x):
    before = frame(pose(x, rotation))
    entry = camera_entry(before)
    np.testing.assert_allclose(read_pose(entry), before.T_world_camera, atol=1e-9)
    assert read_intrinsics(entry, 64, 48) == before.intrinsics


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (frame(pose(MAX_DISTANCE + 0.1)), "the camera is 100 m from the origin"),
        (frame(pose(1e5)), r"the camera is 1e\+05 m from the origin"),
        (frame(f=1e5), "focal lengths 100000, 100000 px are implausible"),
        (frame(f=1.0), "focal lengths 1, 1 px are implausible"),
        (frame(pose(MAX_DISTANCE - 0.1)), None),
        (frame(), None),
    ],
)
def test_what_is_checked_is_what_reading_refuses(written, message):
    def read():
        entry = camera_entry(written)
        read_intrinsics(entry, 64, 48)
        if written.T_world_camera is not None:
            read_pose(entry)

    for function in (read, lambda: check_camera(written)):
        if message is None:
            function()
        else:
            with pytest.raises(InvalidInputError, match=message):
                function()


@pytest.mark.parametrize("value", [None, "1", True, [1, 2], [[1], [2, 3]], float("nan"), 1e10, {}])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(InvalidInputError, match="depth_scale must be a finite number"):
        read_numbers({"depth_scale": value}, "depth_scale", 1)


@pytest.mark.parametrize(("length", "suspected"), [(0, False), (1.5, True), (9.9, True), (10.1, False)])
def test_short_translations_are_probably_in_metres(length, suspected):
    message = suspicion_of_metres([{"cam_t_w2c": [0, 0, 0]}, {"cam_t_w2c": [0, length, 0]}])
    assert (message is not None) == suspected


@pytest.mark.parametrize(("fy", "plausible"), [(41.0, True), (39.0, False), (89.0, True), (91.0, False)])
def test_pixels_are_nearly_square(fy, plausible):
    entry = camera_entry(frame()) | {"cam_K": [60.0, 0, 32, 0, fy, 24, 0, 0, 1]}
    if plausible:
        assert read_intrinsics(entry, 64, 48).fy == fy
        return
    with pytest.raises(InvalidInputError, match="implausible"):
        read_intrinsics(entry, 64, 48)
