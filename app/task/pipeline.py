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

import contextlib
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from app.task.fallen import LEANING, fallen_objects, items_left, left_in_box
from app.task.further_views import most_useful_viewpoint
from app.task.nests import with_bowls_named
from app.task.observation import WristObserver
from app.task.obstacles import (
    beside_box,
    box_interior,
    filled_bounds,
    known_bounds,
    obstacles_beside,
    obstacles_during,
    table_of,
)
from app.task.rounds import (
    as_first_seen,
    has_changed,
    is_something_left,
    is_something_unplaced,
    placed_estimates,
    placed_items,
    renumbered,
    unplaced_estimates,
    with_round,
    without_covered,
)
from app.task.run_observer import RunObserver
from app.task.task_types import Reconstruction, TaskRequest, TaskResult
from app.task.unchanged import with_judged
from manipulation.errors import ManipulationError, PlanningError
from manipulation.execution import execute
from manipulation.further_packing import loose_bowl, plan_further
from manipulation.kinematics import Kinematics
from manipulation.planner import plan_pack, plan_sort
from manipulation.robot import Robot
from manipulation.types import Box, ObjectOutcome, TaskPlan
from manipulation.viewpoints import Viewpoint, ViewpointScanner
from perception.early import EarlyReconstruction
from perception.errors import PerceptionError
from perception.inference.refit import PoseCheck, refit_pose
from perception.inference.turned import refit_turned
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections, Perception, detect, reconstruct_objects
from perception.types import ObjectEstimate, RgbdFrame

logger = logging.getLogger(__name__)

FULL_SCAN = 6  # images of each further round


def run(
    robot: Robot, perception: Perception, request: TaskRequest, observer: RunObserver | None = None
) -> TaskResult:
    """Carry out a task; an error of planning or perception ends it and is stored in the result."""
    observer = observer or RunObserver()
    stages = _Stages(robot, perception, request, observer)
    result = TaskResult()
    try:
        frames, starts = stages.scan_and_begin(request.scan_views)
        while True:
            result = replace(result, frames=frames)
            observer.on_frames(frames)
            detections = stages.detect(frames, known_bounds(request.box))
            result = replace(result, detections=detections)
            observer.on_detections(detections)
            result, viewpoint = stages.reconstruct(result, starts)
            if viewpoint is None:
                break
            frames, starts = [*frames, *stages.capture_further(viewpoint)], result.objects
        if request.perceive_only:
            return replace(result, timings=dict(observer.timings))
        with observer.stage("plan"):
            plan = replace(plan_task(stages.kinematics, request, result.objects), obstacles=result.obstacles)
            if request.task == "pack" and request.rounds > 1:
                plan = without_covered(plan, result.objects)
            result = replace(result, plan=plan)
            observer.on_plan(plan)
        result = replace(result, outcomes=stages.execute(plan, result.objects, detections))
        for left in reversed(range(request.rounds - 1 if request.task == "pack" else 0)):
            further = stages.look_again(result, is_last=left == 0)
            if further is None:
                break
            result = further
        result = stages.verify(result)
        for _ in range(request.rounds - 1 if request.task == "pack" else 0):
            further = stages.place_again(result)
            if further is None:
                break
            if is_something_unplaced(further):  # there may be room now
                further = stages.look_again(further, is_last=True) or further
            result = stages.verify(further)
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
        uses_deviations = request.uncertainty and request.reconstruction is None
        self._latest: list[ObjectOutcome] = []  # of the last round
        self._scanned: Sequence[RgbdFrame] = ()  # images of the last round but the first
        self._tried_in_box: set[int] = set()  # what was left in the box and has been planned for once more
        self._nested: set[int] = set()  # bowls that were to go into others once all was packed
        self._left = list(self._space.further_viewpoints(request.scan_views)) if uses_deviations else []
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

    def reconstruct(
        self, result: TaskResult, starts: Sequence[ObjectEstimate]
    ) -> tuple[TaskResult, Viewpoint | None]:
        """Estimate the objects in the images so far, and what is beside them.

        Returns:
            The results with them, or, where another image is needed first, its viewpoint.
        """
        request, observer, detections = self._request, self._observer, result.detections
        assert detections is not None
        with observer.stage("reconstruct"):
            observer.rejected.clear()  # with fewer images
            prior = prior_reconstruction(self._perception, observer, starts=starts)
            objects = (request.reconstruction or prior)(result.frames, detections)
            result = replace(result, objects=objects, rejected=tuple(observer.rejected))
            viewpoint = self._further_viewpoint(result)
            if viewpoint is None:
                observer.on_objects(objects)
                obstacles = obstacles_beside(objects, result.frames, detections, request.box, self._robot.arm)
                result = replace(result, obstacles=obstacles)
                observer.on_obstacles(obstacles)
        return result, viewpoint

    def _further_viewpoint(self, result: TaskResult) -> Viewpoint | None:
        """Return the viewpoint of an image that uncertain objects need; None without, or if none is left."""
        if not self._left:
            return None
        arm = self._robot.arm
        return most_useful_viewpoint(result.objects, result.rejected, self._left, arm, self._settings)

    def capture_further(self, viewpoint: Viewpoint) -> list[RgbdFrame]:
        """Take an image from a viewpoint that is left; none if it is out of reach."""
        self._left.remove(viewpoint)
        with self._observer.stage("scan"), contextlib.suppress(PlanningError):
            return self.scanner.capture([viewpoint], on_frame=self._observer.on_image)
        return []

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
            goal_views = self._space.line_viewpoints if box is None else self._space.box_viewpoints
            watch = WristObserver(
                self.scanner, objects, plan.objects, self._space, plan.obstacles, look_around,
                goal_views, None if box is None else box_interior(box),
                self._perception.detector if self._request.reconstruction is None else None,
            )  # fmt: skip
            on_event = self._observer.on_event
            outcomes = execute(plan, self._robot, watch, on_event, self._settings, self.kinematics)
        self._latest = outcomes
        return outcomes

    def verify(self, result: TaskResult) -> TaskResult:
        """Return the results with images of the goals and the pose checks of the placed objects in them."""
        request, observer = self._request, self._observer
        with observer.stage("verify"):
            space = request.workspace
            viewpoints = space.box_viewpoints if request.task == "pack" else space.line_viewpoints
            frames = self.scanner.capture(viewpoints, observer.on_progress, observer.on_image)
            result = replace(result, final_frames=frames)
            return replace(result, checks=verify(placed_estimates(result), frames))

    def place_again(self, result: TaskResult) -> TaskResult | None:
        """Return the results after what fell, leans, was turned or does not nest in the box was placed again.

        None if nothing was.
        """
        box, observer = self._request.box or Box(), self._observer
        placed = placed_estimates(result)
        fallen = fallen_objects(placed, result.checks, result.final_frames, box)
        if not fallen:
            result, fallen = self._with_loose_bowl(result, box)
            placed = placed_estimates(result)
        if not fallen or result.detections is None:
            return None
        names = {estimate.name for estimate in fallen}
        beside = [e for e in placed.values() if e.name not in names]
        items = {name: item for name, item in placed_items(result).items() if name not in names}
        try:
            with observer.stage("plan"):
                plan = plan_further(fallen, items, box, self._robot.arm, self._settings, self.kinematics)
                plan = replace(plan, obstacles=result.obstacles)
        except (ManipulationError, PerceptionError) as error:
            logger.info("%s cannot be placed again: %s", ", ".join(sorted(names)), error)
            return None
        again = self._carry_out(result, fallen, plan, beside, result.obstacles, result.detections)
        return as_first_seen(again, result)

    def _with_loose_bowl(self, result: TaskResult, box: Box) -> tuple[TaskResult, list[ObjectEstimate]]:
        """Return the results with all bowls named, and one that is to go into another, each once at most."""
        if self._request.reconstruction is None:
            result = with_bowls_named(result, box, self._perception)
        bowl = loose_bowl(placed_items(result), box, self._settings.for_arm(self._robot.arm))
        if bowl is None or bowl.id in self._nested:
            return result, []
        self._nested.add(bowl.id)
        return result, [placed_estimates(result)[bowl.id]]

    def _carry_out(
        self,
        result: TaskResult,
        found: Sequence[ObjectEstimate],
        plan: TaskPlan,
        in_box: Sequence[ObjectEstimate],
        obstacles: Sequence[PerceivedObstacle],
        detections: Detections,
    ) -> TaskResult:
        """Return the results with those of the plan of one more round.

        Args:
            result: Results of the rounds before.
            found: Objects that the plan has goals for.
            plan: The plan.
            in_box: Other objects in the box.
            obstacles: Things of no class.
            detections: Detections, of which the surface of the table is used.
        """
        planned = with_round(result, found, plan, (), obstacles)
        assert planned.plan is not None
        self._observer.on_objects(planned.objects)
        self._observer.on_obstacles(obstacles)
        self._observer.on_plan(planned.plan)
        outcomes = self.execute(plan, [*in_box, *found], detections)
        return with_round(result, found, plan, outcomes, obstacles)

    def look_again(self, result: TaskResult, is_last: bool) -> TaskResult | None:
        """Return the results with those of one more round; None if there is nothing more to do."""
        request, observer = self._request, self._observer
        box, n_rejected = request.box or Box(), len(observer.rejected)
        if not is_something_left(result, self._latest):
            return None
        try:
            frames = self.scan(FULL_SCAN)
            detections = self.detect(frames, filled_bounds(box))
            detections = with_judged(
                detections, frames, self._scanned or result.frames, unplaced_estimates(result)
            )
            self._scanned = frames
            with observer.stage("reconstruct"):
                # The ids of these fits are not yet those of the objects.
                reconstruct = request.reconstruction or prior_reconstruction(
                    self._perception, observer, shows_fits=False
                )
                found = renumbered(reconstruct(frames, detections), result.objects, box)
                left = left_in_box(result, box)
                found += [estimate for estimate in left if estimate.id not in self._tried_in_box]
                stuck = [estimate for estimate in left if estimate.id in self._tried_in_box]
                self._tried_in_box |= {estimate.id for estimate in left}
                in_box = [*placed_estimates(result).values(), *stuck]
                table = table_of(detections)
                obstacles = obstacles_during([*in_box, *found], frames, table, box, self._robot.arm)
            with observer.stage("plan"):
                items = placed_items(result) | items_left(result, stuck)
                plan = plan_further(found, items, box, self._robot.arm, self._settings, self.kinematics)
                plan = replace(plan, obstacles=obstacles)
                if has_changed(self._latest) and not is_last:
                    plan = without_covered(plan, found)
        except (ManipulationError, PerceptionError) as error:
            logger.info("nothing more to do: %s", error)
            return None
        result = replace(result, rejected=tuple(observer.rejected[n_rejected:]))
        further = self._carry_out(result, found, plan, in_box, obstacles, detections)
        return as_first_seen(further, result)


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
    if not request.uncertainty:
        objects = [replace(estimate, surface_sigma=None) for estimate in objects]
    if request.task == "pack":
        return plan_pack(objects, request.box or Box(), kinematics.arm, settings, kinematics)
    return plan_sort(objects, request.line, kinematics.arm, settings, request.box, kinematics)


def verify(placed: Mapping[int, ObjectEstimate], frames: Sequence[RgbdFrame]) -> dict[int, PoseCheck]:
    """Fit the poses of the placed objects to images of the goal region; return the checks by object id.

    Upright mugs are tried with their handles in other directions as well.
    """
    checks = {}
    for object_id, estimate in placed.items():
        others = [other for other in placed.values() if other is not estimate]
        T = estimate.T_world_object
        check = refit_pose(estimate, frames, T, others)
        if estimate.category == "mug" and check.status == "seen" and check.tilt < LEANING:
            check = refit_turned(estimate, frames, T, others) or check
        checks[object_id] = check
    return checks
