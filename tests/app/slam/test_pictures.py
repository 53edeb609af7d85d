"""Upscaled frames and the position error over time."""

import numpy as np

from app.slam.pictures import MappedSequence, _draw_error, enlarged, new_figure
from perception.io.recordings.trajectory import Trajectory
from perception.types import CameraIntrinsics, RgbdFrame


def test_an_enlarged_frame_sees_the_same_rays():
    k = CameraIntrinsics(32, 24, 30.0, 31.0, 15.5, 11.5)
    depth = np.arange(32 * 24, dtype=np.float32).reshape(24, 32) / 1000
    large = enlarged(RgbdFrame(0.0, np.zeros((24, 32, 3), np.uint8), depth, k), width=96)
    assert large.depth.shape == (72, 96) and large.intrinsics.fx == 90.0 and large.intrinsics.fy == 93.0
    np.testing.assert_array_equal(large.depth[1::3, 1::3], depth)  # pixel 3 i + 1 is the middle of pixel i
    ray = (3 * 7 + 1 - large.intrinsics.cx) / large.intrinsics.fx
    np.testing.assert_allclose(ray, (7 - k.cx) / k.fx)
    assert enlarged(large, width=96).depth.shape == (72, 96)


def test_the_error_is_the_distance_at_common_times_in_millimetres():
    Ts = np.tile(np.eye(4), (3, 1, 1))
    truth = Trajectory(np.array([0.0, 0.1, 0.2]), Ts)
    moved = np.array(Ts[1:])
    moved[:, :3, 3] = [0.003, 0.004, 0.0]
    axis = new_figure(4, 3).subplots()
    _draw_error(axis, MappedSequence([], Trajectory(np.array([0.1, 0.3]), moved), []), truth)
    (line,) = axis.lines
    np.testing.assert_allclose(line.get_xdata(), [0.1])
    np.testing.assert_allclose(line.get_ydata(), [5.0])
