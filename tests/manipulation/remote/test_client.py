"""The client over a real socket: the same values as directly; every fault ends in a stop with its reason."""

import threading
import time
from dataclasses import replace
from datetime import date

import numpy as np
import pytest

from manipulation.errors import RobotError, RobotStoppedError
from manipulation.kinematics import Kinematics
from manipulation.remote.calibration import HandEye
from manipulation.remote.client import RemoteRobot
from manipulation.robot import Robot
from tests.manipulation.remote.conftest import QUICK, FakeRobot, a_move, an_image, serving


def test_it_is_a_robot_with_the_same_values_to_the_last_bit(client, robot):
    assert isinstance(client, Robot)
    robot.q = robot.q + 1e-13
    np.testing.assert_array_equal(client.joint_positions(), robot.q)
    state, direct = client.state(), robot.state()
    assert (state.time, state.gripper_width) == (direct.time, direct.gripper_width)
    received, sent = client.capture(), robot.capture()
    for name in ("rgb", "depth", "T_world_camera"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))
    assert received.intrinsics == sent.intrinsics and received.time == sent.time


def test_motions_are_carried_out(client, robot):
    move = a_move(robot.arm)
    client.follow(move)
    np.testing.assert_array_equal(robot.q, move.positions[-1])
    assert client.move_gripper(0.03) == 0.03 == client.gripper_width()
    assert client.follow_opening(move.reversed(), 0.05) == 0.05 == robot.width
    np.testing.assert_array_equal(robot.q, move.positions[0])


def test_the_hand_opens_in_motion_where_the_robot_beside_the_server_can(client, robot):
    calls = []

    def follow_opening(trajectory, width):
        calls.append((trajectory.duration, width))
        return width

    robot.follow_opening = follow_opening
    client.follow_opening(a_move(robot.arm), 0.05)
    assert calls == [(pytest.approx(0.2), 0.05)] and robot.calls == []


def test_a_refused_trajectory_is_named_and_the_robot_goes_on(client, robot):
    with pytest.raises(RobotError, match=r"starts 0\.500 rad from the measured position of joint1"):
        far = a_move(robot.arm)
        client.follow(replace(far, positions=far.positions + np.eye(7)[0] * 0.5))
    assert robot.calls == [] and not robot.stopped
    client.follow(a_move(robot.arm))


def test_a_dropped_frame_is_asked_for_again(client, robot):
    def dropped(now):
        raise RobotError("no image from the camera within 1 s")

    robot.frames = [dropped]
    assert client.capture().time == robot.now and robot.calls.count("capture") == 2
    robot.frames = [dropped] * 3
    with pytest.raises(RobotStoppedError, match=r"^the robot was stopped: no image from the camera"):
        client.capture()
    assert robot.stopped == "no image from the camera within 1 s"
    with pytest.raises(RobotStoppedError):
        client.follow(a_move(robot.arm))
    assert "follow" not in robot.calls


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (lambda now: an_image(now - 2), r"the image is 2\.00 s old, 0\.5 s at most"),
        (lambda now: an_image(now + 1), r"the image is -1\.00 s old"),
        (lambda now: an_image(np.nan), r"the image is nan s old"),
        (lambda now: an_image(now - 0.1), r"image and joint state are 0\.100 s apart, 0\.02 s at most"),
        (lambda now: an_image(now, None), "no camera pose: give a hand-eye calibration"),
    ],
)
def test_late_and_unposed_frames_stop_the_robot(client, robot, frame, reason):
    robot.frames = [frame] * QUICK.attempts
    with pytest.raises(RobotStoppedError, match=reason):
        client.capture()
    assert robot.stopped


@pytest.mark.parametrize("late", [0.3, -0.3, np.nan, np.inf])
def test_a_late_state_stops_the_robot(client, robot, late):
    robot.late = late
    with pytest.raises(RobotStoppedError, match=r"the joint state is .* s old"):
        client.joint_positions()
    assert robot.stopped


def test_a_state_that_is_not_finite_stops_the_robot(client, robot):
    robot.q = robot.q * np.nan
    with pytest.raises(RobotStoppedError, match="not finite"):
        client.state()
    assert robot.stopped


def test_a_driver_that_fails_stops_the_robot(client, robot):
    robot.frames = [lambda now: 1 / 0]
    with pytest.raises(RobotStoppedError, match="the robot failed: ZeroDivisionError"):
        client.capture()
    assert "ZeroDivisionError" in robot.stopped


def test_a_silent_server_is_noticed_in_time(arm, robot):
    with serving(robot) as server:
        client = RemoteRobot(arm, server.address, config=QUICK)
    begin = time.monotonic()
    with client, pytest.raises(RobotStoppedError, match=r"no answer to a motion within 1\.2 s"):
        client.follow(a_move(arm))
    assert time.monotonic() - begin < 6


def test_long_motions_are_waited_for(arm):
    slow = FakeRobot(arm, seconds=1.6)  # longer than the silence that counts as a loss
    with serving(slow) as server, RemoteRobot(arm, server.address, config=QUICK) as client:
        client.follow(a_move(arm))
        assert not slow.stopped


def test_stop_by_another_process_ends_the_motion(arm):
    slow = FakeRobot(arm, seconds=30)
    with serving(slow) as server, RemoteRobot(arm, server.address, config=QUICK) as client:
        threading.Timer(0.2, slow.stop, args=("a person is near",)).start()
        with pytest.raises(RobotStoppedError, match="a person is near"):
            client.follow(a_move(arm))


def test_the_camera_pose_follows_from_the_calibration_at_the_exposure(arm, robot, served):
    T_tcp_camera = np.eye(4)
    T_tcp_camera[:3, 3] = (0.06, 0.0, -0.05)
    with RemoteRobot(arm, served.address, HandEye(T_tcp_camera, 0.0, 0.0, date.today()), QUICK) as client:
        robot.frames = [lambda now: an_image(now, None)]
        expected = Kinematics(arm).forward(robot.q) @ T_tcp_camera
        np.testing.assert_allclose(client.capture().T_world_camera, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:1", "no robot answers at .* within 0.2 s: start its server"),
        ("tcp://nowhere", "is no address"),
        ("http://127.0.0.1:80", "give tcp://HOST:PORT or ipc://PATH"),
        ("", "is no address"),
    ],
)
def test_addresses_without_a_robot(arm, address, message):
    with pytest.raises(RobotError, match=message):
        RemoteRobot(arm, address, config=replace(QUICK, connect=0.2))


def test_another_arm_is_refused(arm, served):
    other = replace(arm, joint_names=tuple(f"axis{i}" for i in range(7)))
    with pytest.raises(RobotError, match=r"has the joints joint1, .* the robot file axis0"):
        RemoteRobot(other, served.address, config=QUICK)
    wide = replace(arm, gripper=replace(arm.gripper, max_width=0.085))
    with pytest.raises(RobotError, match=r"opens 0\.0800 m, that of the robot file 0\.0850 m"):
        RemoteRobot(wide, served.address, config=QUICK)
