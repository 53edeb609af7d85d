"""A plan, a cell in which nothing moves, and stages of a task that record their arguments."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import app.task.further_rounds
import app.task.pipeline
import app.task.stages
from app.task.run_observer import RunObserver
from manipulation.robot import RobotState
from manipulation.standing import to_standing
from manipulation.types import Box, ObjectOutcome, Placement, TaskPlan
from manipulation.viewpoints import ViewpointScanner
from perception.geometry import pose_from_yaw
from perception.inference.refit import PoseCheck
from perception.pipeline import Detections, Perception
from perception.types import SupportPlane
from sim_assets.cell.world import World
from sim_assets.robots import panda


class StillWorld(World):
    """The members of the cell that storing a run needs; counts the images that are rendered."""

    def __init__(self):
        pass

    time = 1.5
    config = SimpleNamespace(scale=1.0)
    drawn = 0

    def overview_image(self, *size, camera="overview", **_):
        self.drawn += 1
        width, height = size or (96, 72)
        return np.zeros((height, width, 3), np.uint8)

    def observe(self, observer, rate=0.0):
        self.observer = observer

    def joint_positions(self):
        return np.zeros(7)

    def gripper_width(self):
        return 0.08


@pytest.fixture
def still_world() -> StillWorld:
    return StillWorld()


@pytest.fixture
def pack_plan(can_at) -> TaskPlan:
    """Two cans, of which the first one is placed in the middle of the box."""
    items = {estimate.name: to_standing(estimate) for estimate in (can_at(0), can_at(1, 0.5))}
    placements = (Placement("can_0", (0.5, 0.27, 0.004), (0.0,)),)
    return TaskPlan("pack", items, placements, {"can_1": "too far"}, box=Box())


class StillRobot:
    arm = panda().description

    def state(self):
        return RobotState(0.0, self.joint_positions(), self.gripper_width())

    def stop(self, reason):
        raise AssertionError(reason)

    def joint_positions(self):
        return self.arm.q_home

    def gripper_width(self):
        return 0.08

    def follow(self, trajectory):
        pass

    def move_gripper(self, width):
        return width

    def capture(self):
        raise NotImplementedError


class Scanner(ViewpointScanner):
    """Returns one image per call; records the viewpoints and whether postures of before were asked for."""

    def __init__(self, frame):
        self.frame, self.visited, self.as_before, self.error = frame, [], [], None

    def capture(self, viewpoints, progress=None, on_frame=None, as_before=False):
        self.visited.append(tuple(viewpoints))
        self.as_before.append(as_before)
        if self.error is not None:
            raise self.error
        if on_frame is not None:
            on_frame(self.frame)
        return [self.frame]


class Recording(RunObserver):
    def __init__(self):
        super().__init__()
        self.calls = []

    def stage(self, name):
        self.calls.append(name)
        return super().stage(name)

    def on_image(self, frame):
        self.calls.append("image")

    def on_frames(self, frames):
        self.calls.append(("frames", len(frames)))

    def on_detections(self, detections):
        self.calls.append(detections)

    def on_objects(self, objects):
        self.calls.append(("objects", [estimate.id for estimate in objects]))

    def on_plan(self, plan):
        self.calls.append(plan)


SEEN = PoseCheck(np.eye(4), "seen", 0.9, 500, 0.01, 0.02)
FOUND = Detections(SupportPlane(), ((),))


class FakeDetector:
    def complete(self, frame, plane, detections):
        return list(detections)


DETECTOR = FakeDetector()


@pytest.fixture
def stages(monkeypatch, overhead_frame, can_at, pack_plan):
    """The replaced stages, and what they were called with."""
    scanner, calls = Scanner(overhead_frame), {}
    objects = [can_at(0), can_at(1, 0.5)]
    outcomes = [ObjectOutcome(0, "can_0", True, 1, "", pose_from_yaw(0.0, np.array([0.5, 0.27, 0.004])))]

    def replace(name, value):
        """Replace what the stages and rounds of a task import."""
        modules = [
            m for m in (app.task.pipeline, app.task.stages, app.task.further_rounds) if hasattr(m, name)
        ]
        assert modules, name
        for module in modules:
            monkeypatch.setattr(module, name, value)

    def stage(name, result):
        def call(*args, **options):
            calls[name] = (*args, *options.items())
            if isinstance(result, Exception):
                raise result
            return result

        replace(name, call)

    replace("ViewpointScanner", lambda robot, kinematics, **settings: scanner)
    stage("detect", FOUND)
    stage("reconstruct_objects", objects)
    stage("plan_pack", pack_plan)
    stage("plan_sort", pack_plan)
    stage("execute", outcomes)
    stage("refit_pose", SEEN)
    replace("with_bowls_named", lambda result, *args: result)
    replace("cut_by_borders", lambda *args: [])
    replace("revealing_viewpoints", lambda *args: [])
    replace("may_hide_an_object", lambda *args: False)
    perception = object.__new__(Perception)
    object.__setattr__(perception, "detector", DETECTOR)
    object.__setattr__(perception, "decoder", "decoder")
    return SimpleNamespace(
        scanner=scanner, calls=calls, objects=objects, outcomes=outcomes, perception=perception, stage=stage,
        replace=replace,
    )  # fmt: skip
