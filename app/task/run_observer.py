"""Observer of a task: receives intermediate results for display and storage, and never modifies them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from manipulation.execution import TaskEvent
from manipulation.types import TaskPlan
from perception.inference.optimisation import FitStep
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import Category, ObjectEstimate, RejectedObject, RgbdFrame

Stage = Literal["scan", "detect", "reconstruct", "plan", "execute", "verify"]


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
