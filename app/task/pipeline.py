"""One task from scan to verification: scan, detect, reconstruct, plan, execute, verify.

Read this file first. Each stage is a function from values to a new value, and data flows in one direction:

    robot ──scan──▶ frames ──detect──▶ detections ──reconstruct──▶ object map, obstacles
          ──plan──▶ task plan ──execute──▶ outcomes ──verify──▶ pose checks

The robot is any implementation of ``manipulation.robot.Robot``. This module imports neither the simulator nor
ground truth: the robot's images and joint positions are its only measurements. A ``RunObserver`` receives
intermediate results for display and storage and never modifies them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from app.task.observation import WristObserver
from app.task.obstacles import beside_box, obstacles_beside, obstacles_during, table_of
from manipulation.errors import ManipulationError
from manipulation.execution import TaskEvent, execute
from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig, plan_pack, plan_sort
from manipulation.robot import Robot
from manipulation.types import Box, Line, ObjectOutcome, Task, TaskPlan
from manipulation.viewpoints import ViewpointScanner
from manipulation.workspace import Workspace
from perception.errors import PerceptionError
from perception.inference.optimisation import FitStep
from perception.inference.refit import PoseCheck, refit_pose
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections, Perception, detect, reconstruct_objects
from perception.types import Category, ObjectEstimate, RejectedObject, RgbdFrame

Stage = Literal["scan", "detect", "reconstruct", "plan", "execute", "verify"]
Reconstruction = Callable[[Sequence[RgbdFrame], Detections], list[ObjectEstimate]]


@dataclass(frozen=True)
class TaskRequest:
    """Specification of a task.

    Attributes:
        task: "pack" or "sort".
        box: Box to pack into, or an obstacle while sorting; None if there is no box.
        line: Line to sort along.
        reconstruction: Source of the object estimates; None for the learned shape prior.
        manipulation: Settings of planning and execution.
        scan_views: Number of images of the scan.
        workspace: Viewpoints and heights of motions, scaled to the arm.
        perceive_only: Whether the task ends with the object map, before anything is moved.
    """

    task: Task
    box: Box | None = None
    line: Line = field(default_factory=Line)
    reconstruction: Reconstruction | None = None
    manipulation: ManipulationConfig = field(default_factory=ManipulationConfig)
    scan_views: int = 6
    workspace: Workspace = Workspace()
    perceive_only: bool = False


@dataclass(frozen=True)
class TaskResult:
    """Results of all stages; those after a failed stage keep their defaults.

    Attributes:
        frames: Images of the scan.
        detections: Detections in the images of the scan.
        objects: Object map.
        rejected: Detected objects that are not in the object map, with the reasons.
        obstacles: Things of no class.
        plan: Placements in their order of execution.
        outcomes: Outcome of each placement as reported by execution.
        checks: Pose check of each object that was placed, by object id.
        final_frames: Images of the goal region after execution.
        failure: Message of the error that ended the task; empty if there was none.
        timings: Wall time of each stage without pauses, in seconds.
    """

    frames: Sequence[RgbdFrame] = ()
    detections: Detections | None = None
    objects: Sequence[ObjectEstimate] = ()
    rejected: Sequence[RejectedObject] = ()
    obstacles: Sequence[PerceivedObstacle] = ()
    plan: TaskPlan | None = None
    outcomes: Sequence[ObjectOutcome] = ()
    checks: Mapping[int, PoseCheck] = field(default_factory=dict)
    final_frames: Sequence[RgbdFrame] = ()
    failure: str = ""
    timings: Mapping[str, float] = field(default_factory=dict)


class RunObserver:
    """Receives intermediate results of a run; the base class keeps those that no stage returns.

    Attributes:
        timings: Wall time of each finished stage without pauses, in seconds.
        rejected: Detected objects that were not reconstructed.
    """

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        self.rejected: list[RejectedObject] = []

    @property
    def paused_seconds(self) -> float:
        """Total wall time that the run has been paused, in seconds."""
        return 0.0

    @contextmanager
    def stage(self, name: Stage) -> Iterator[None]:
        """Enclose a stage."""
        begin, paused = time.perf_counter(), self.paused_seconds
        try:
            yield
        finally:
            self.timings[name] = time.perf_counter() - begin - (self.paused_seconds - paused)

    def on_remark(self, text: str) -> None:
        """Called before the first stage with what is special about the cell, or impossible for the arm."""

    def on_progress(self, done: int, total: int, subject: str = "") -> None:
        """Called within a stage after each of its ``total`` steps."""

    def on_image(self, frame: RgbdFrame) -> None:
        """Called with each image of the wrist camera."""

    def on_frames(self, frames: Sequence[RgbdFrame]) -> None:
        """Called with all images of the scan."""

    def on_detections(self, detections: Detections) -> None:
        """Called with the detections in the images of the scan."""

    def on_fit_step(self, object_id: int, category: Category, step: FitStep) -> None:
        """Called after each iteration of the fit of an object, from several threads."""

    def on_rejected(self, rejected: RejectedObject) -> None:
        """Called with each detected object that is left out of the object map."""
        self.rejected.append(rejected)

    def on_objects(self, objects: Sequence[ObjectEstimate]) -> None:
        """Called with the object map."""

    def on_obstacles(self, obstacles: Sequence[PerceivedObstacle]) -> None:
        """Called with the things of no class."""

    def on_plan(self, plan: TaskPlan) -> None:
        """Called with the task plan."""

    def on_event(self, event: TaskEvent) -> None:
        """Called at each step of execution."""


def run(
    robot: Robot, perception: Perception, request: TaskRequest, observer: RunObserver | None = None
) -> TaskResult:
    """Carry out a task; an error of planning or perception ends it and is stored in the result."""
    observer = observer or RunObserver()
    kinematics = Kinematics(robot.arm, request.manipulation.pick_place.ik)
    settings = request.workspace.adapted(request.manipulation)
    result = TaskResult()
    try:
        with observer.stage("scan"):
            space = request.workspace
            scanner = ViewpointScanner(
                robot, kinematics, keep_out=space.keep_out, via_heights=space.via_heights
            )
            frames = scanner.capture(
                space.scan_viewpoints(request.scan_views), observer.on_progress, observer.on_image
            )
            result = replace(result, frames=frames)
            observer.on_frames(frames)
        with observer.stage("detect"):
            # The planner lets objects stand on the table alone.
            found = detect(frames, perception.detector, observer.on_progress, max_surfaces=1)
            detections = beside_box(request.box, frames, found)
            result = replace(result, detections=detections)
            observer.on_detections(detections)
        with observer.stage("reconstruct"):
            reconstruct = request.reconstruction or prior_reconstruction(perception, observer)
            objects = reconstruct(frames, detections)
            result = replace(result, objects=objects, rejected=tuple(observer.rejected))
            observer.on_objects(objects)
            obstacles = obstacles_beside(objects, frames, detections, request.box, robot.arm)
            result = replace(result, obstacles=obstacles)
            observer.on_obstacles(obstacles)
        if request.perceive_only:
            return replace(result, timings=dict(observer.timings))
        with observer.stage("plan"):
            plan = replace(plan_task(kinematics, request, objects), obstacles=obstacles)
            result = replace(result, plan=plan)
            observer.on_plan(plan)
        with observer.stage("execute"):
            look_around = partial(
                obstacles_during, surface=table_of(detections), box=request.box, arm=robot.arm
            )
            watch = WristObserver(scanner, objects, plan.objects, space, obstacles, look_around)
            outcomes = execute(plan, robot, watch, observer.on_event, settings, kinematics)
            result = replace(result, outcomes=outcomes)
        with observer.stage("verify"):
            viewpoints = space.box_viewpoints if request.task == "pack" else space.line_viewpoints
            final_frames = scanner.capture(viewpoints, observer.on_progress, observer.on_image)
            result = replace(result, final_frames=final_frames)
            result = replace(result, checks=verify(objects, plan, outcomes, final_frames))
    except (ManipulationError, PerceptionError) as error:
        result = replace(result, failure=str(error))
    return replace(result, timings=dict(observer.timings))


def prior_reconstruction(perception: Perception, observer: RunObserver) -> Reconstruction:
    """Return the reconstruction by the learned shape prior."""

    def reconstruct(frames: Sequence[RgbdFrame], detections: Detections) -> list[ObjectEstimate]:
        return reconstruct_objects(
            frames,
            detections,
            perception.decoder,
            observer.on_progress,
            observer.on_fit_step,
            observer.on_rejected,
            clutter=perception.detector,
        )

    return reconstruct


def plan_task(kinematics: Kinematics, request: TaskRequest, objects: Sequence[ObjectEstimate]) -> TaskPlan:
    """Plan the goal pose of each object and the order of execution.

    Raises:
        PlanningError: No object can be placed; the message gives the reasons.
    """
    settings = request.workspace.adapted(request.manipulation)
    if request.task == "pack":
        return plan_pack(objects, request.box or Box(), kinematics.arm, settings, kinematics)
    return plan_sort(objects, request.line, kinematics.arm, settings, request.box, kinematics)


def verify(
    objects: Sequence[ObjectEstimate],
    plan: TaskPlan,
    outcomes: Sequence[ObjectOutcome],
    frames: Sequence[RgbdFrame],
) -> dict[int, PoseCheck]:
    """Fit the poses of the known shapes to images of the goal region; return the checks by object id."""
    by_id = {estimate.id: estimate for estimate in objects}
    expected = {
        outcome.id: replace(by_id[outcome.id], T_world_object=expected_pose(by_id[outcome.id], plan, outcome))
        for outcome in outcomes
        if outcome.placed
    }
    checks = {}
    for object_id, estimate in expected.items():
        others = [other for other in expected.values() if other is not estimate]
        checks[object_id] = refit_pose(estimate, frames, estimate.T_world_object, others)
    return checks


def expected_pose(
    estimate: ObjectEstimate, plan: TaskPlan, outcome: ObjectOutcome
) -> Float[np.ndarray, "4 4"]:
    """Return T_world_object of a placed object; its pose in the stand frame is unchanged by execution."""
    assert outcome.T_world_stand is not None
    T_stand_object = np.linalg.inv(plan.objects[outcome.name].T_world_stand) @ estimate.T_world_object
    return outcome.T_world_stand @ T_stand_object
