"""One task from the first look to the last: scan, detect, reconstruct, plan, execute, verify.

Read this file first. Each stage is a function from values to a new value; data goes one way:

    robot ──scan──▶ frames ──detect──▶ detections ──reconstruct──▶ object map
          ──plan──▶ task plan ──execute──▶ outcomes ──verify (look again)──▶ checks

The robot is anything that implements ``manipulation.robot.Robot``: nothing here knows of a simulator, or of
where objects really are. A ``Watcher`` observes what each stage makes, to show and to store it, and never
writes back.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from manipulation.errors import ManipulationError
from manipulation.execution import TaskEvent, execute
from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig, plan_pack, plan_sort
from manipulation.robot import Robot
from manipulation.types import Box, Line, ObjectOutcome, Task, TaskPlan
from manipulation.viewpoints import BOX_VIEWS, LINE_VIEWS, SCAN_VIEWS, close_views, look
from perception.errors import PerceptionError
from perception.inference.fit import FitStep
from perception.inference.refit import PoseCheck, refit_pose
from perception.pipeline import Detections, Perception, detect, reconstruct_objects
from perception.types import Category, ObjectEstimate, RgbdFrame

_log = logging.getLogger(__name__)

Shapes = Callable[[Sequence[RgbdFrame], Detections], list[ObjectEstimate]]


@dataclass(frozen=True)
class Goal:
    """What the robot is to do.

    Attributes:
        task: "pack" or "sort".
        box: where to pack; None for sorting.
        line: where to sort.
        shapes: another source of object estimates than reconstruction by the shape prior.
        manipulation: settings of planning and execution.
    """

    task: Task
    box: Box | None = None
    line: Line = field(default_factory=Line)
    shapes: Shapes | None = None
    manipulation: ManipulationConfig = field(default_factory=ManipulationConfig)


@dataclass(frozen=True)
class Outcome:
    """Everything the stages made; what comes after a failed stage is empty.

    Attributes:
        frames: of the scan.
        detections: of the scan.
        objects: the object map.
        plan: what was to be done.
        outcomes: what the robot believes it did.
        checks: where each placed object was seen to stand afterwards, by id.
        final_frames: of the last look.
        problem: why a stage failed, or an empty string.
        timings: wall seconds of each stage.
    """

    frames: Sequence[RgbdFrame] = ()
    detections: Detections | None = None
    objects: Sequence[ObjectEstimate] = ()
    plan: TaskPlan | None = None
    outcomes: Sequence[ObjectOutcome] = ()
    checks: dict[int, PoseCheck] = field(default_factory=dict)
    final_frames: Sequence[RgbdFrame] = ()
    problem: str = ""
    timings: dict[str, float] = field(default_factory=dict)


class Watcher:
    """Observes a run; this one only takes the time."""

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Around each stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.timings[name] = time.perf_counter() - begin

    def progress(self, done: int, total: int, what: str = "") -> None:
        """Within a stage."""

    def looked(self, frame: RgbdFrame) -> None:
        """The wrist camera took an image."""

    def fit_step(self, object_id: int, category: Category, step: FitStep) -> None:
        """How the fit of an object goes on; called from several threads."""

    def event(self, event: TaskEvent) -> None:
        """What the robot begins or has done with an object."""

    def made(self, name: str, value: Any) -> None:
        """What a stage made."""


def run(robot: Robot, perception: Perception, goal: Goal, watcher: Watcher | None = None) -> Outcome:
    """Carry out the whole task; a stage that fails ends it, with its problem named."""
    watcher = watcher or Watcher()
    kinematics = Kinematics(robot.arm)
    made: dict[str, Any] = {}

    def keep(name: str, value: Any) -> Any:
        made[name] = value
        watcher.made(name, value)
        return value

    try:
        with watcher.stage("scan"):
            seen = look(robot, kinematics, SCAN_VIEWS, watcher.progress, on_frame=watcher.looked)
            frames = keep("frames", seen)
        with watcher.stage("detect"):
            detections = keep("detections", detect(frames, perception.detector, watcher.progress))
        with watcher.stage("reconstruct"):
            shapes = goal.shapes or prior_shapes(perception, watcher)
            objects = keep("objects", shapes(frames, detections))
        with watcher.stage("plan"):
            plan = keep("plan", plan_task(robot, goal, objects))
        with watcher.stage("execute"):
            again = look_again(robot, kinematics, objects)
            outcomes = keep("outcomes", execute(plan, robot, again, watcher.event, goal.manipulation))
        with watcher.stage("verify"):
            views = BOX_VIEWS if goal.task == "pack" else LINE_VIEWS
            seen = look(robot, kinematics, views, watcher.progress, on_frame=watcher.looked)
            final_frames = keep("final_frames", seen)
            keep("checks", verify(objects, plan, outcomes, final_frames))
    except (ManipulationError, PerceptionError) as error:
        made["problem"] = str(error)
    return Outcome(**made, timings=dict(watcher.timings))


def prior_shapes(perception: Perception, watcher: Watcher) -> Shapes:
    """Reconstruction by the learned shape prior."""

    def shapes(frames: Sequence[RgbdFrame], detections: Detections) -> list[ObjectEstimate]:
        return reconstruct_objects(frames, detections, perception.decoder, watcher.progress, watcher.fit_step)

    return shapes


def plan_task(robot: Robot, goal: Goal, objects: Sequence[ObjectEstimate]) -> TaskPlan:
    """What goes where, and in which order.

    Raises:
        PlanningError: nothing can be done; the message says why.
    """
    if goal.task == "pack":
        return plan_pack(objects, goal.box or Box(), robot.arm, goal.manipulation)
    return plan_sort(objects, goal.line, robot.arm, goal.manipulation, goal.box)


def look_again(
    robot: Robot, kinematics: Kinematics, objects: Sequence[ObjectEstimate]
) -> Callable[[int], ObjectEstimate | None]:
    """For a failed grasp: where the object stands now, by fitting its known shape to new images from near."""
    by_id = {estimate.id: estimate for estimate in objects}

    def again(object_id: int) -> ObjectEstimate | None:
        estimate = by_id[object_id]
        x, y = estimate.T_world_object[:2, 3]
        try:
            frames = look(robot, kinematics, close_views((float(x), float(y), 0.05)))
            check = refit_pose(estimate, frames, estimate.T_world_object)
        except (ManipulationError, PerceptionError) as error:
            _log.info("looking again at %s: %s", estimate.name, error)
            return None
        return replace(estimate, T_world_object=check.T_world_object) if check.status == "seen" else None

    return again


def verify(
    objects: Sequence[ObjectEstimate],
    plan: TaskPlan,
    outcomes: Sequence[ObjectOutcome],
    frames: Sequence[RgbdFrame],
) -> dict[int, PoseCheck]:
    """Fit the known shapes, pose only, to images of where they should stand now; by object id."""
    by_id = {estimate.id: estimate for estimate in objects}
    expected = {
        outcome.id: replace(by_id[outcome.id], T_world_object=_carried(by_id[outcome.id], plan, outcome))
        for outcome in outcomes
        if outcome.placed
    }
    checks = {}
    for number, estimate in expected.items():
        others = [other for other in expected.values() if other is not estimate]
        checks[number] = refit_pose(estimate, frames, estimate.T_world_object, others)
    return checks


def _carried(estimate: ObjectEstimate, plan: TaskPlan, outcome: ObjectOutcome) -> Float[np.ndarray, "4 4"]:
    """T_world_object after the object was carried from where it stood to where it was put."""
    assert outcome.T_world_stand is not None
    T_stand_object = np.linalg.inv(plan.objects[outcome.name].T_world_stand) @ estimate.T_world_object
    return outcome.T_world_stand @ T_stand_object
