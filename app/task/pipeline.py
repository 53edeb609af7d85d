"""One task from scan to verification: scan, detect, reconstruct, plan, execute, verify.

Read this file first. Each stage is a function from values to a new value, and data flows in one direction:

    robot ──scan──▶ frames ──detect──▶ detections ──reconstruct──▶ object map, obstacles
          ──plan──▶ task plan ──execute──▶ outcomes ──verify──▶ pose checks

``app.task.stages`` has the stages. While something is left on the table, all of them before the verification
are repeated (``app.task.further_rounds``).

The robot is any implementation of ``manipulation.robot.Robot``. This module imports neither the simulator nor
ground truth: the robot's images and joint positions are its only measurements. A ``RunObserver`` receives
intermediate results for display and storage and never modifies them.
"""

from __future__ import annotations

from dataclasses import replace

from app.task.further_rounds import FurtherRounds
from app.task.obstacles import known_bounds
from app.task.rounds import is_something_unplaced, without_covered
from app.task.run_observer import RunObserver
from app.task.stages import Stages, plan_task
from app.task.task_types import TaskRequest, TaskResult
from manipulation.errors import ManipulationError
from manipulation.robot import Robot
from perception.errors import PerceptionError
from perception.pipeline import Perception


def run(
    robot: Robot, perception: Perception, request: TaskRequest, observer: RunObserver | None = None
) -> TaskResult:
    """Carry out a task; an error of planning or perception ends it and is stored in the result."""
    observer = observer or RunObserver()
    stages = Stages(robot, perception, request, observer)
    rounds = FurtherRounds(stages)
    result = TaskResult()
    try:
        frames, starts = stages.scan_and_begin(request.scan_views)
        while True:
            result = replace(result, frames=frames)
            observer.on_frames(frames)
            detections = stages.detect(frames, known_bounds(request.box))
            result = replace(result, detections=detections)
            observer.on_detections(detections)
            result, viewpoints = stages.reconstruct(result, starts)
            if not viewpoints:
                break
            frames, starts = [*frames, *stages.capture_further(viewpoints)], result.objects
        if request.perceive_only:
            return replace(result, timings=dict(observer.timings))
        with observer.stage("plan"):
            plan = replace(plan_task(stages.kinematics, request, result.objects), obstacles=result.obstacles)
            if request.rounds > 1:
                plan = without_covered(plan, result.objects)
            result = replace(result, plan=plan)
            observer.on_plan(plan)
        result = replace(result, outcomes=stages.execute(plan, result.objects, detections))
        for left in reversed(range(request.rounds - 1)):
            latest = rounds.look_again(result, is_last=left == 0)
            if latest is None:
                break
            result = latest
        result = stages.verify(result)
        for _ in range(request.rounds - 1):
            latest = rounds.place_again(result)
            if latest is None:
                break
            if is_something_unplaced(latest):  # there may be room now
                latest = rounds.look_again(latest, is_last=True) or latest
            result = stages.verify(latest)
    except (ManipulationError, PerceptionError) as error:
        result = replace(result, failure=str(error))
    return replace(result, timings=dict(observer.timings))
