"""Specification and results of a task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from manipulation.planner import ManipulationConfig
from manipulation.types import Box, Line, ObjectOutcome, Task, TaskPlan
from manipulation.workspace import Workspace
from perception.inference.refit import PoseCheck
from perception.obstacles.obstacle import PerceivedObstacle
from perception.pipeline import Detections
from perception.types import ObjectEstimate, RejectedObject, RgbdFrame

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
        uncertainty: Whether the standard deviations of the estimates widen clearances, rank grasps, and ask
            for further images of the scan, and whether the table is looked at again in the end where the scan
            may have hidden an object.
        perceive_only: Whether the task ends with the object map, before anything is moved.
        rounds: Most scans of a task; further ones look for what is left on the table.
    """

    task: Task
    box: Box | None = None
    line: Line = field(default_factory=Line)
    reconstruction: Reconstruction | None = None
    manipulation: ManipulationConfig = field(default_factory=ManipulationConfig)
    scan_views: int = 6
    workspace: Workspace = Workspace()
    uncertainty: bool = True
    perceive_only: bool = False
    rounds: int = 6

    @property
    def filled_box(self) -> Box | None:
        """Box of a packing task; None for sorting, where a box is an obstacle."""
        return (self.box or Box()) if self.task == "pack" else None


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
