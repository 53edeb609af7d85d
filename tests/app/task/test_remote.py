"""A task with a robot in another process: faults, options, and the outcome beside that of the cell."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import app.task.remote as remote
from app.errors import UsageError
from app.options import PackOptions
from app.screen import Screen
from app.task.task_types import TaskResult
from manipulation.errors import RobotError, RobotStoppedError
from manipulation.remote.server import RobotServer
from manipulation.robot import RobotState
from manipulation.types import ObjectOutcome, TaskPlan
from perception.inference.refit import PoseCheck
from perception.pipeline import Perception
from perception.types import CameraIntrinsics, RgbdFrame
from sim_assets.robots import panda

ROOT = Path(__file__).parents[3]


def check(status="seen", shift=0.002, tilt=0.01):
    return PoseCheck(np.eye(4), status, 0.9, 1000, tilt, shift)


class Robot:
    """Moves at once; each fault is one of those that real cells have."""

    def __init__(self, fault):
        self.arm, self.fault, self.stopped, self.now = panda().description, fault, "", 5.0
        self.q = np.array(self.arm.q_home)

    def state(self):
        late = 1.0 if self.fault == "late state" else 0.0
        return RobotState(self.now - late, self.q.copy(), self.arm.max_width)

    def joint_positions(self):
        return self.q.copy()

    def gripper_width(self):
        return self.arm.max_width

    def follow(self, trajectory):
        if self.fault == "refused trajectory":
            raise RobotError("the controller refuses the trajectory: joint4")
        if self.fault == "stop":
            self.stop("the light curtain was crossed")
        if self.stopped:
            raise RobotStoppedError(f"the robot was stopped: {self.stopped}")
        self.q, self.now = trajectory.positions[-1].copy(), self.now + trajectory.duration

    def move_gripper(self, width):
        return width

    def capture(self):
        if self.fault == "dropped frame":
            raise RobotError("no image from the camera within 1 s")
        camera = CameraIntrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
        depth = np.full((48, 64), 0.6, np.float32)
        return RgbdFrame(self.now, np.zeros((48, 64, 3), np.uint8), depth, camera, np.eye(4))

    def stop(self, reason):
        self.stopped = reason


FAULTS = {
    "dropped frame": ("no image from the camera within 1 s", True),
    "late state": ("the joint state is 1.00 s old, 0.1 s at most", True),
    "refused trajectory": ("the controller refuses the trajectory: joint4", False),
    "stop": ("the robot was stopped: the light curtain was crossed", True),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_ends_in_a_stop_and_a_report_with_its_reason(fault, tmp_path, monkeypatch):
    monkeypatch.setattr(remote, "load_perception", lambda device: object.__new__(Perception))
    robot, end = Robot(fault), threading.Event()
    with RobotServer(robot, "tcp://127.0.0.1:0", clock=lambda: robot.now) as server:
        thread = threading.Thread(target=server.run, args=(end,))
        thread.start()
        try:
            options = PackOptions(connect=server.address, out=tmp_path / "run")
            report = remote.run(options, "pack", Screen(quiet=True))
        finally:
            end.set()
            thread.join()
    reason, stopped = FAULTS[fault]
    assert not report.success and reason in report.reason and bool(robot.stopped) == stopped
    stored = json.loads((tmp_path / "run" / "report.json").read_text())
    assert stored["reason"] == report.reason and stored["command"] == "pack"
    assert (tmp_path / "run" / "overview.png").exists()


def test_objects_are_judged_by_the_robots_own_verification(can_at):
    objects = [can_at(0), can_at(1, 0.5), can_at(2, 0.6)]
    plan = TaskPlan("pack", {}, (), {"can_2": "out of reach"})
    outcomes = [ObjectOutcome(i, f"can_{i}", True, 1, "", np.eye(4)) for i in (0, 1)]
    result = TaskResult(
        objects=objects, plan=plan, outcomes=outcomes, checks={0: check(), 1: check(shift=0.05)}
    )
    report = remote.report_of(PackOptions(connect="tcp://h:1"), "pack", result, 3.0)
    assert [entry.placed for entry in report.objects] == [True, False, False]
    assert report.objects[2].reason == "out of reach" and not report.success
    assert report.reason.startswith("1 of 3 objects seen in place; can 1: not seen in place")
    complete = TaskResult(objects=objects[:1], outcomes=outcomes[:1], checks={0: check()})
    assert remote.report_of(PackOptions(), "pack", complete, 3.0).success
    assert not remote.report_of(PackOptions(), "pack", TaskResult(), 3.0).success


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"objects": "4"}, "--objects describes the simulated cell: give it to nodeslam serve"),
        ({"clutter": True}, "--clutter"),
        ({"camera_error": "1,0"}, "--camera-error"),
        ({"shapes": "oracle"}, "--shapes, --fault, --view, --video and --log need"),
        ({"video": True}, "leave them out with --connect"),
    ],
)
def test_options_of_the_simulated_cell_are_refused(given, message):
    with pytest.raises(UsageError, match=message):
        remote.check_options(PackOptions(connect="tcp://127.0.0.1:1", **given))
    remote.check_options(PackOptions(connect="tcp://127.0.0.1:1", robot="sixaxis", box="0.3,0.3,0.08"))


def test_a_missing_robot_is_bad_input_and_nothing_is_written(tmp_path):
    options = PackOptions(connect="http://nowhere", out=tmp_path / "run")
    with pytest.raises(UsageError, match="give tcp://HOST:PORT"):
        remote.run(options, "pack", Screen(quiet=True))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_same_seed_has_the_same_outcome_as_directly(tmp_path):
    def nodeslam(*arguments):
        return [sys.executable, "-m", "app", *map(str, arguments)]

    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    cell, address = ("--objects", "3", "--seed", "1"), f"ipc://{tmp_path}/robot"
    server = subprocess.Popen(
        nodeslam("serve", *cell, "--address", address), env=environment, stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None and "robot at" in server.stdout.readline()
        command = nodeslam("pack", "--connect", address, "--seed", 1, "--out", tmp_path / "remote", "--quiet")
        subprocess.run(command, env=environment, check=True, timeout=600)
    finally:
        server.terminate()
        server.communicate(timeout=60)
    command = nodeslam("pack", *cell, "--out", tmp_path / "direct", "--quiet")
    subprocess.run(command, env=environment, check=True, timeout=600)
    for name in ("objects.json", "plan.json", "scan/detections.json"):
        assert (tmp_path / "remote" / name).read_bytes() == (tmp_path / "direct" / name).read_bytes(), name
