"""A robot that moves at once, a clock set by hand, and the two ends of a connection in one process."""

import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from manipulation.errors import RobotStoppedError
from manipulation.remote.client import LinkConfig, RemoteRobot
from manipulation.remote.server import RobotServer
from manipulation.robot import JointTrajectory, RobotState
from perception.types import CameraIntrinsics, RgbdFrame

# Limits that make faults quick.
QUICK = LinkConfig(connect=1.0, silence=1.2, reading=2.0, motion=2.0)


class FakeRobot:
    """Moves in ``seconds`` of real time; ``late`` is the age of states, ``frames`` replaces images."""

    def __init__(self, arm, seconds=0.0):
        self.arm, self.seconds = arm, seconds
        self.q, self.width, self.now, self.late = np.array(arm.q_home), arm.max_width, 10.0, 0.0
        self.frames, self.calls, self.stopped = [], [], ""

    def state(self):
        return RobotState(self.now - self.late, self.q.copy(), self.width)

    def joint_positions(self):
        return self.q.copy()

    def gripper_width(self):
        return self.width

    def follow(self, trajectory):
        self.calls.append("follow")
        end = time.monotonic() + self.seconds
        while time.monotonic() < end:
            time.sleep(0.01)
            if self.stopped:
                raise RobotStoppedError(self.stopped)
        self.now += trajectory.duration
        self.q = trajectory.positions[-1].copy()

    def move_gripper(self, width):
        self.calls.append("gripper")
        self.width = width
        return width

    def capture(self):
        self.calls.append("capture")
        return self.frames.pop(0)(self.now) if self.frames else an_image(self.now)

    def stop(self, reason):
        self.stopped = self.stopped or reason


def an_image(now, T_world_camera=np.eye(4)):
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 0.9, (12, 16)).astype(np.float32)
    intrinsics = CameraIntrinsics(16, 12, np.float64(15.0), 15.0, 7.5, 5.5)  # numpy's numbers too
    return RgbdFrame(
        now, rng.integers(0, 255, (12, 16, 3), dtype=np.uint8), depth, intrinsics, T_world_camera
    )


def a_move(arm, joint=0, angle=0.1, period=0.01, samples=21):
    """A motion of one joint from home with a smooth velocity profile."""
    s = np.linspace(0, 1, samples)
    profile = np.stack(
        [s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2, 60 * s * (1 - 3 * s + 2 * s**2)]
    )
    duration = period * (samples - 1)
    unit = np.zeros(len(arm.joint_names))
    unit[joint] = angle
    q, qd, qdd = (profile[:, :, None] * unit) / np.array([1, duration, duration**2])[:, None, None]
    return JointTrajectory(period, arm.q_home + q, qd, qdd)


@contextmanager
def serving(robot, **settings):
    """Serve a robot in a thread; yield the server."""
    end = threading.Event()
    with RobotServer(robot, "tcp://127.0.0.1:0", clock=lambda: robot.now, **settings) as server:
        thread = threading.Thread(target=server.run, args=(end,))
        thread.start()
        try:
            yield server
        finally:
            end.set()
            thread.join()


@pytest.fixture
def robot(arm):
    return FakeRobot(arm)


@pytest.fixture
def served(robot):
    with serving(robot) as server:
        yield server


@pytest.fixture
def client(robot, served):
    with RemoteRobot(robot.arm, served.address, config=QUICK) as client:
        yield client
