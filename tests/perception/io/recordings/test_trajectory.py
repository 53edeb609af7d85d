"""Trajectories in the TUM format: order of the numbers, round trip, malformed lines."""

import numpy as np
import pytest

from perception.errors import InvalidInputError
from perception.geometry import se3_exp
from perception.io.recordings.trajectory import Trajectory, read_trajectory, write_trajectory

QUARTER_TURN = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # about z


def test_round_trip(tmp_path):
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(size=6)) for _ in range(5)]
    write_trajectory(tmp_path / "t.txt", Trajectory.of([0.0, 0.5, 1.0, 1.5, 2.0], poses))
    back = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(back.Ts_world_camera, poses, atol=1e-7)
    np.testing.assert_allclose(back.times, [0, 0.5, 1, 1.5, 2])


def test_a_malformed_line_is_named(tmp_path):
    (tmp_path / "t.txt").write_text("# comment\n0 0 0 0 0 0 0 1\n1 2 3\n")
    with pytest.raises(InvalidInputError, match=r"t\.txt, line 3 is not a pose"):
        read_trajectory(tmp_path / "t.txt")


def test_a_line_is_time_translation_and_quaternion_with_the_scalar_last(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("# timestamp tx ty tz qx qy qz qw\n\n7.5 1 2 3 0 0 0.70710678 0.70710678\n")
    read = read_trajectory(path)
    np.testing.assert_allclose(read.times, [7.5])
    np.testing.assert_allclose(read.Ts_world_camera[0, :3, :3], QUARTER_TURN, atol=1e-8)
    np.testing.assert_allclose(read.Ts_world_camera[0, :3, 3], (1, 2, 3))
    write_trajectory(path, read)
    numbers = [float(word) for word in path.read_text().splitlines()[1].split()]
    np.testing.assert_allclose(numbers, [7.5, 1, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-8)


def test_a_missing_file_and_an_empty_one(tmp_path):
    with pytest.raises(InvalidInputError, match=r"t\.txt cannot be read .*give a TUM trajectory"):
        read_trajectory(tmp_path / "t.txt")
    (tmp_path / "t.txt").write_text("# nothing\n")
    assert read_trajectory(tmp_path / "t.txt").Ts_world_camera.shape == (0, 4, 4)


@pytest.mark.parametrize("number", ["nan", "inf", "1e999"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, number):
    for position in range(4):
        words = ["1"] * 8
        words[position] = number
        (tmp_path / "t.txt").write_text(" ".join(words))
        with pytest.raises(InvalidInputError, match=r"t\.txt, line 1 is not a pose \(.*finite.*\): time tx"):
            read_trajectory(tmp_path / "t.txt")


def test_quaternions_whose_norm_overflows_are_refused(tmp_path):
    (tmp_path / "t.txt").write_text("0 1 2 3" + 4 * " 1e308")
    with pytest.raises(InvalidInputError, match=r"t\.txt, line 1 is not a pose"):
        read_trajectory(tmp_path / "t.txt")


def test_the_nearest_pose_within_the_tolerance():
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 5
    trajectory = Trajectory.of([0.0, 1.0], poses)
    nearest = trajectory.nearest(0.9, 0.11)
    assert nearest is not None and nearest[0, 3] == 5
    assert trajectory.nearest(0.5, 0.4) is None
    assert Trajectory.of([], []).nearest(0.0, 1.0) is None


@pytest.mark.parametrize("line", ["0 1e7 0 0 0 0 0 1", "0 0 0 0 0 0 0 0.5", "0 0 0 0 1 1 1 1"])
def test_implausible_poses_are_refused(tmp_path, line):
    (tmp_path / "t.txt").write_text(line)
    with pytest.raises(InvalidInputError, match=r"t\.txt, line 1 is not a pose \(its"):
        read_trajectory(tmp_path / "t.txt")


def test_a_byte_order_mark_is_skipped(tmp_path):
    (tmp_path / "t.txt").write_text("# time\n0 1 2 3 0 0 0 1\n", encoding="utf-8-sig")
    assert len(read_trajectory(tmp_path / "t.txt").times) == 1
