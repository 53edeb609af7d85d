"""One task from scan to verification: scan, detect, reconstruct, plan, execute, verify.

Read this file first. Each stage is a function from values to a new value, and data flows in one direction:

    robot ──scan──▶ frames ──detect──▶ detections ──reconstruct──▶ object map, obstacles
          ──plan──▶ task plan ──execute──▶ outcomes ──verify──▶ pose checks

While a packing task leaves something on the table, all stages before the verification are repeated
(``app.task.rounds``).

The robot is any implementation of ``manipulation.robot.Robot``. This module imports neither the simulator nor
ground truth: the robot's images and joint positions are its only measurements. A ``RunObserver`` receives
intermediate results for display and storage and never modifies them.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float

from app.task.observation import WristObserver
from app.task.obstacles import (
    beside_box,
    filled_bounds,
    known_bounds,
    obstacles_beside,
    obstacles_during,
    table_of,
)
from app.task.rounds import is_something_left, placed_estimates, placed_items, renumbered, with_round
from manipulation.errors import ManipulationError
from manipulation.execution import TaskEvent, execute
from manipulation.further_packing import plan_further
from manipulation.kinematics import Kinematics
from manipulation.planner import ManipulationConfig, plan_pack, plan_sort
from manipulation.robot import Robot
from manipulation.types import Box, Line, ObjectOutcome, Task, TaskPlan
from manipulation.viewpoints import ViewpointScanner
from manipulation.workspace import Workspace
from perception.early import EarlyReconstruction
from perception.errors import PerceptionError
from perception.inference.optimisation import FitStep
from perception.inference.refit import PoseCheck, refit_pose
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections, Perception, detect, reconstruct_objects
from perception.types import Category, ObjectEstimate, RejectedObject, RgbdFrame

logger = logging.getLogger(__name__)

FULL_SCAN = 6  # images of each further round
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
        rounds: Most scans of a packing task; further ones look for what is left on the table.
    """

    task: Task
    box: Box | None = None
    line: Line = field(default_factory=Line)
    reconstruction: Reconstruction | None = None
    manipulation: ManipulationConfig = field(default_factory=ManipulationConfig)
    scan_views: int = 6
    workspace: Workspace = Workspace()
    perceive_only: bool = False
    rounds: int = 3


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
        timings: Wall time of each finished stage without pauses, of all rounds together, in seconds.
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
            seconds = time.perf_counter() - begin - (self.paused_seconds - paused)
            self.timings[name] = self.timings.get(name, 0.0) + seconds

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
    stages = _Stages(robot, perception, request, observer)
    result = TaskResult()
    try:
        frames, starts = stages.scan_and_begin(request.scan_views)
        result = replace(result, frames=frames)
        observer.on_frames(frames)
        detections = stages.detect(frames, known_bounds(request.box))
        result = replace(result, detections=detections)
        observer.on_detections(detections)
        with observer.stage("reconstruct"):
            reconstruct = request.reconstruction or prior_reconstruction(perception, observer, starts=starts)
            objects = reconstruct(frames, detections)
            result = replace(result, objects=objects, rejected=tuple(observer.rejected))
            observer.on_objects(objects)
            obstacles = obstacles_beside(objects, frames, detections, request.box, robot.arm)
            result = replace(result, obstacles=obstacles)
            observer.on_obstacles(obstacles)
        if request.perceive_only:
            return replace(result, timings=dict(observer.timings))
        with observer.stage("plan"):
            plan = replace(plan_task(stages.kinematics, request, objects), obstacles=obstacles)
            result = replace(result, plan=plan)
            observer.on_plan(plan)
        result = replace(result, outcomes=stages.execute(plan, objects, detections))
        for _ in range(request.rounds - 1 if request.task == "pack" else 0):
            further = stages.look_again(result)
            if further is None:
                break
            result = further
        with observer.stage("verify"):
            viewpoints = (
                request.workspace.box_viewpoints
                if request.task == "pack"
                else request.workspace.line_viewpoints
            )
            final_frames = stages.scanner.capture(viewpoints, observer.on_progress, observer.on_image)
            result = replace(result, final_frames=final_frames)
            result = replace(result, checks=verify(placed_estimates(result), final_frames))
    except (ManipulationError, PerceptionError) as error:
        result = replace(result, failure=str(error))
    return replace(result, timings=dict(observer.timings))


class _Stages:
    """The stages that are repeated in each round of a task."""

    def __init__(
        self, robot: Robot, perception: Perception, request: TaskRequest, observer: RunObserver
    ) -> None:
        self._robot, self._perception, self._request, self._observer = robot, perception, request, observer
        self.kinematics = Kinematics(robot.arm, request.manipulation.pick_place.ik)
        self._space = request.workspace
        self._settings = self._space.adapted(request.manipulation)
        self.scanner = ViewpointScanner(
            robot, self.kinematics, keep_out=self._space.keep_out, via_heights=self._space.via_heights
        )

    def scan_and_begin(self, count: int) -> tuple[list[RgbdFrame], Sequence[ObjectEstimate]]:
        """Take images of the table; return them with the objects of the first half of them.

        These are reconstructed while the arm moves, and are the starting points of the fits to all images.
        """
        after = count // 2 if self._request.reconstruction is None else 0
        with EarlyReconstruction(self._first_objects, after) as early, self._observer.stage("scan"):
            return self._capture(count, early.add), early.estimates()

    def scan(self, count: int) -> list[RgbdFrame]:
        """Take images of the table from a number of viewpoints."""
        with self._observer.stage("scan"):
            return self._capture(count)

    def _capture(
        self, count: int, on_image: Callable[[RgbdFrame], None] = lambda frame: None
    ) -> list[RgbdFrame]:
        def receive(frame: RgbdFrame) -> None:
            on_image(frame)
            self._observer.on_image(frame)

        viewpoints = self._space.scan_viewpoints(count)
        return self.scanner.capture(viewpoints, self._observer.on_progress, receive)

    def _first_objects(self, frames: Sequence[RgbdFrame]) -> list[ObjectEstimate]:
        """Reconstruct upright objects; called from another thread, without reports to the observer."""
        detector, decoder = self._perception.detector, self._perception.decoder
        return reconstruct_objects(frames, detect(frames, detector, max_surfaces=1), decoder)

    def detect(self, frames: Sequence[RgbdFrame], known: Float[np.ndarray, "k 2 3"]) -> Detections:
        """Detect objects on the table besides known geometry, of which the bounds [m] are given."""
        with self._observer.stage("detect"):
            # The planner lets objects stand on the table alone.
            found = detect(frames, self._perception.detector, self._observer.on_progress, max_surfaces=1)
            return beside_box(known, frames, found)

    def execute(
        self, plan: TaskPlan, objects: Sequence[ObjectEstimate], detections: Detections
    ) -> list[ObjectOutcome]:
        """Carry out a plan while the wrist camera watches."""
        with self._observer.stage("execute"):
            arm, box = self._robot.arm, self._request.box
            look_around = partial(obstacles_during, surface=table_of(detections), box=box, arm=arm)
            on_table = self._space.line_viewpoints if box is None else ()
            watch = WristObserver(
                self.scanner, objects, plan.objects, self._space, plan.obstacles, look_around, on_table
            )
            return execute(plan, self._robot, watch, self._observer.on_event, self._settings, self.kinematics)

    def look_again(self, result: TaskResult) -> TaskResult | None:
        """Return the results with those of one more round; None if there is nothing more to do."""
        request, observer = self._request, self._observer
        box, n_rejected = request.box or Box(), len(observer.rejected)
        if not is_something_left(result):
            return None
        try:
            frames = self.scan(FULL_SCAN)
            detections = self.detect(frames, filled_bounds(box))
            with observer.stage("reconstruct"):
                # The ids of these fits are not yet those of the objects.
                reconstruct = request.reconstruction or prior_reconstruction(
                    self._perception, observer, shows_fits=False
                )
                found = renumbered(reconstruct(frames, detections), result.objects, box)
                in_box = list(placed_estimates(result).values())
                table = table_of(detections)
                obstacles = obstacles_during([*in_box, *found], frames, table, box, self._robot.arm)
            with observer.stage("plan"):
                items = placed_items(result)
                plan = plan_further(found, items, box, self._robot.arm, self._settings, self.kinematics)
                plan = replace(plan, obstacles=obstacles)
        except (ManipulationError, PerceptionError) as error:
            logger.info("nothing more to do: %s", error)
            return None
        result = replace(result, rejected=tuple(observer.rejected[n_rejected:]))
        planned = with_round(result, found, plan, (), obstacles)
        assert planned.plan is not None
        observer.on_objects(planned.objects)
        observer.on_obstacles(obstacles)
        observer.on_plan(planned.plan)
        outcomes = self.execute(plan, [*in_box, *found], detections)
        return with_round(result, found, plan, outcomes, obstacles)


def prior_reconstruction(
    perception: Perception,
    observer: RunObserver,
    shows_fits: bool = True,
    starts: Sequence[ObjectEstimate] = (),
) -> Reconstruction:
    """Return the reconstruction by the learned shape prior.

    Args:
        perception: The networks.
        observer: Receives progress and rejected objects.
        shows_fits: Whether it receives the iterations of the fits.
        starts: Estimates from fewer images, at which the fits start.
    """

    def reconstruct(frames: Sequence[RgbdFrame], detections: Detections) -> list[ObjectEstimate]:
        return reconstruct_objects(
            frames,
            detections,
            perception.decoder,
            observer.on_progress,
            observer.on_fit_step if shows_fits else None,
            observer.on_rejected,
            clutter=perception.detector,
            starts=starts,
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


def verify(placed: Mapping[int, ObjectEstimate], frames: Sequence[RgbdFrame]) -> dict[int, PoseCheck]:
    """Fit the poses of the placed objects to images of the goal region; return the checks by object id."""
    checks = {}
    for object_id, estimate in placed.items():
        others = [other for other in placed.values() if other is not estimate]
        checks[object_id] = refit_pose(estimate, frames, estimate.T_world_object, others)
    return checks
