"""The stages of a task: scan, detect, reconstruct, plan, execute, verify."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from app.task.fallen import LEANING
from app.task.further_views import MOST_CLOSER, cut_by_borders, most_useful_viewpoint, things_never_whole
from app.task.hidden_places import revealing_viewpoints
from app.task.observation import WristObserver
from app.task.obstacles import (
    beside_box,
    box_interior,
    obstacles_beside,
    obstacles_during,
    table_of,
    unexplained_during,
)
from app.task.rounds import placed_estimates
from app.task.run_observer import RunObserver
from app.task.task_types import Reconstruction, TaskRequest, TaskResult
from manipulation.errors import PlanningError
from manipulation.execution import execute
from manipulation.kinematics import Kinematics
from manipulation.planner import plan_pack, plan_sort
from manipulation.robot import Robot
from manipulation.types import Box, ObjectOutcome, TaskPlan
from manipulation.viewpoints import Viewpoint, ViewpointScanner
from perception.detection.completion import Completer
from perception.early import EarlyReconstruction
from perception.inference.handle import handle_yaw
from perception.inference.refit import PoseCheck, refit_pose
from perception.inference.turned import refit_turned
from perception.pipeline import Detections, Perception, detect, reconstruct_objects
from perception.types import ObjectEstimate, RgbdFrame, SupportPlane

FULL_SCAN = 6  # images of each further round


class Stages:
    """The stages of a task with what they share.

    Args:
        robot: The robot.
        perception: The networks.
        request: The task.
        observer: Receives intermediate results.

    Attributes:
        kinematics: Kinematics of the robot's arm.
        settings: Settings of planning in the request's workspace.
        scanner: Takes images from viewpoints.
        latest: Outcomes of the last round.
    """

    def __init__(
        self, robot: Robot, perception: Perception, request: TaskRequest, observer: RunObserver
    ) -> None:
        self.robot, self.perception, self.request, self.observer = robot, perception, request, observer
        self.kinematics = Kinematics(robot.arm, request.manipulation.pick_place.ik)
        self._space = request.workspace
        self.settings = self._space.adapted(request.manipulation)
        uses_deviations = request.uncertainty and request.reconstruction is None
        self.latest: list[ObjectOutcome] = []
        self._looked_closer = False
        self._left = list(self._space.further_viewpoints(request.scan_views)) if uses_deviations else []
        self.scanner = ViewpointScanner(
            robot, self.kinematics, keep_out=self._space.keep_out, via_heights=self._space.via_heights
        )

    @property
    def _handles(self) -> Completer | None:
        """Network that tells the directions of mugs' handles; None where depth alone does."""
        return self.perception.detector if self.request.reconstruction is None else None

    def scan_and_begin(self, count: int) -> tuple[list[RgbdFrame], Sequence[ObjectEstimate]]:
        """Take images of the table; return them with the objects of the first half of them.

        These are reconstructed while the arm moves, and are the starting points of the fits to all images.
        """
        after = count // 2 if self.request.reconstruction is None else 0
        with EarlyReconstruction(self._first_objects, after) as early, self.observer.stage("scan"):
            return self._capture(count, early.add), early.estimates()

    def scan(self, count: int) -> list[RgbdFrame]:
        """Take images of the table from a number of viewpoints."""
        with self.observer.stage("scan"):
            return self._capture(count)

    def capture_nearby(self, places: Sequence[tuple[float, float]]) -> list[RgbdFrame]:
        """Take images of places (x, y) [m] on the table from nearby; none if they are out of reach."""
        with self.observer.stage("scan"):
            return self.look_at(places)

    def look_at(self, places: Sequence[tuple[float, float]]) -> list[RgbdFrame]:
        """Take the same images within another stage."""
        viewpoints = self._closeups(places)
        with contextlib.suppress(PlanningError):
            return self.scanner.capture(viewpoints, on_frame=self.observer.on_image) if viewpoints else []
        return []

    def look_into_box(self) -> list[RgbdFrame]:
        """Take images of the box."""
        with self.observer.stage("scan"):
            return self.scanner.capture(self._space.box_viewpoints, on_frame=self.observer.on_image)

    def _capture(
        self, count: int, on_image: Callable[[RgbdFrame], None] = lambda frame: None
    ) -> list[RgbdFrame]:
        def receive(frame: RgbdFrame) -> None:
            on_image(frame)
            self.observer.on_image(frame)

        viewpoints = self._space.scan_viewpoints(count)
        return self.scanner.capture(viewpoints, self.observer.on_progress, receive, as_before=True)

    def _first_objects(self, frames: Sequence[RgbdFrame]) -> list[ObjectEstimate]:
        """Reconstruct upright objects; called from another thread, without reports to the observer."""
        detector, decoder = self.perception.detector, self.perception.decoder
        return reconstruct_objects(frames, detect(frames, detector, max_surfaces=1), decoder)

    def reconstruct(
        self, result: TaskResult, starts: Sequence[ObjectEstimate]
    ) -> tuple[TaskResult, Sequence[Viewpoint]]:
        """Estimate the objects in the images so far, and what is beside them.

        Returns:
            The results with them, or, where other images are needed first, their viewpoints.
        """
        request, observer, detections = self.request, self.observer, result.detections
        assert detections is not None
        with observer.stage("reconstruct"):
            observer.rejected.clear()  # with fewer images
            prior = prior_reconstruction(self.perception, observer, starts=starts)
            objects = (request.reconstruction or prior)(result.frames, detections)
            result = replace(result, objects=objects, rejected=tuple(observer.rejected))
            viewpoints = self._further_viewpoints(result)
            if not viewpoints:
                obstacles = obstacles_beside(objects, result.frames, detections, request.box, self.robot.arm)
                result = replace(result, obstacles=obstacles)
                viewpoints = self._closer_viewpoints(result)
            if not viewpoints:
                observer.on_objects(objects)
                observer.on_obstacles(result.obstacles)
        return result, viewpoints

    def _further_viewpoints(self, result: TaskResult) -> Sequence[Viewpoint]:
        """Return the viewpoints of images that are needed; none if nothing needs one, or none is left.

        They show where an object may be hidden, else what is uncertain.
        """
        if not self._left:
            return ()
        assert result.detections is not None
        arm, area, plane = self.robot.arm, self.settings.free_area, table_of(result.detections).plane
        hidden = revealing_viewpoints(result.frames, result.objects, area, self._left, plane)
        if hidden:
            return hidden
        found = most_useful_viewpoint(result.objects, result.rejected, self._left, arm, self.settings)
        return () if found is None else (found,)

    def _closer_viewpoints(self, result: TaskResult) -> Sequence[Viewpoint]:
        """Return, once, the viewpoints near what the borders of the images cut."""
        if self._looked_closer or self.request.reconstruction is not None:
            return ()
        self._looked_closer = True
        places = cut_by_borders(result.objects, result.frames)
        return self._closeups([*places, *things_never_whole(result.obstacles, result.frames)][:MOST_CLOSER])

    def capture_further(self, viewpoints: Sequence[Viewpoint]) -> list[RgbdFrame]:
        """Take images from further viewpoints; none if they are out of reach."""
        self._left = [viewpoint for viewpoint in self._left if viewpoint not in viewpoints]
        with self.observer.stage("scan"), contextlib.suppress(PlanningError):
            return self.scanner.capture(viewpoints, on_frame=self.observer.on_image, as_before=True)
        return []

    def _closeups(self, places: Sequence[tuple[float, float]]) -> list[Viewpoint]:
        return [v for x, y in places for v in self._space.closeup_viewpoints(x, y)]

    def detect(self, frames: Sequence[RgbdFrame], known: Float[np.ndarray, "k 2 3"]) -> Detections:
        """Detect objects on the table besides known geometry, of which the bounds [m] are given."""
        with self.observer.stage("detect"):
            # The planner lets objects stand on the table alone.
            found = detect(frames, self.perception.detector, self.observer.on_progress, max_surfaces=1)
            return beside_box(known, frames, found)

    def execute(
        self, plan: TaskPlan, objects: Sequence[ObjectEstimate], detections: Detections
    ) -> list[ObjectOutcome]:
        """Carry out a plan while the wrist camera watches."""
        with self.observer.stage("execute"):
            arm, box = self.robot.arm, self.request.box
            table = table_of(detections)
            look_around = partial(obstacles_during, surface=table, box=box, arm=arm)
            unexplained = partial(unexplained_during, surface=table, box=box)
            goal_views = self._space.line_viewpoints if box is None else self._space.box_viewpoints
            watch = WristObserver(
                self.scanner, objects, plan.objects, self._space, plan.obstacles, look_around,
                unexplained, goal_views, None if box is None else box_interior(box), self._handles,
            )  # fmt: skip
            on_event = self.observer.on_event
            outcomes = execute(
                plan, self.robot, watch, on_event, self.settings, self.kinematics, ends_home=False
            )
        self.latest = outcomes
        return outcomes

    def verify(self, result: TaskResult) -> TaskResult:
        """Return the results with images of the goals and the pose checks of the placed objects in them."""
        request, observer = self.request, self.observer
        with observer.stage("verify"):
            space = request.workspace
            viewpoints = space.box_viewpoints if request.task == "pack" else space.line_viewpoints
            frames = self.scanner.capture(viewpoints, observer.on_progress, observer.on_image)
            result = replace(result, final_frames=frames)
            return replace(result, checks=verify(placed_estimates(result), frames, self._handles))


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


def verify(
    placed: Mapping[int, ObjectEstimate], frames: Sequence[RgbdFrame], handles: Completer | None = None
) -> dict[int, PoseCheck]:
    """Fit the poses of the placed objects to images of the goal region; return the checks by object id.

    Upright mugs are tried with their handles in other directions as well.

    Args:
        placed: Estimates of the placed objects at their expected poses, by id.
        frames: Images of the goal region.
        handles: Network that tells the directions of mugs' handles; None to tell them by depth alone.
    """
    checks = {}
    for object_id, estimate in placed.items():
        others = [other for other in placed.values() if other is not estimate]
        T = estimate.T_world_object
        check = refit_pose(estimate, frames, T, others)
        if estimate.category == "mug" and check.status == "seen" and check.tilt < LEANING:
            see_yaw = None
            if handles is not None:
                see_yaw = partial(
                    handle_yaw, frames=frames, others=others, plane=SupportPlane(), network=handles
                )
            check = refit_turned(estimate, frames, T, others, see_yaw=see_yaw) or check
        checks[object_id] = check
    return checks
